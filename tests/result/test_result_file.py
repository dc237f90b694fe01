"""The result file: what is written comes back, viewers find their way, nothing broken is ever left behind."""

from __future__ import annotations

import dataclasses
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from trapcli.errors import InputError, OutputError
from trapcli.result.motion import FLAG_MEANINGS, Landscape, Motion


def assert_same(a: Motion, b: Motion) -> None:
    for field in dataclasses.fields(Motion):
        x, y = getattr(a, field.name), getattr(b, field.name)
        if isinstance(x, np.ndarray):
            assert x.dtype == y.dtype, field.name
            np.testing.assert_array_equal(x, y, err_msg=field.name)
        elif not isinstance(x, Landscape):
            assert x == y, field.name


@pytest.fixture
def motion(make_motion):
    """A result with everything in it: gaps, flags, errors, Φ."""
    motion = make_motion(30)
    gap = np.isin(motion.frame, [0, 7, 8, 29])

    def hole(values):
        values = values.copy()
        values[gap] = np.nan
        return values

    rng = np.random.default_rng(1)
    return dataclasses.replace(
        motion,
        frame=100 + 2 * motion.frame,
        phi=hole(motion.phi),
        R=hole(motion.R),
        T=hole(motion.T),
        phi_errors=rng.random(30),
        R_errors=rng.random((30, 3)),
        valid=np.where(gap, 0, 1).astype(np.uint8),
        flags=np.where(gap, 1 | 64, 0).astype(np.uint16),
        identifiable=False,
        verdict="the object looks rotationally symmetric",
        landscape=Landscape(np.linspace(0, np.pi, 9), np.array([102, 104]), rng.random((2, 9))),
        provenance={
            "program": "trap-motion",
            "configuration": '[motion]\nmethod = "paper"\n',
            "inputs": "ab  ü",
        },
    )


class TestRoundTrip:
    def test_everything_comes_back(self, motion, tmp_path):
        motion.save(tmp_path / "a.h5")
        again = Motion.load(tmp_path / "a.h5")
        assert_same(motion, again)
        np.testing.assert_array_equal(again.landscape.phi, motion.landscape.phi)
        np.testing.assert_array_equal(again.landscape.frame, motion.landscape.frame)
        np.testing.assert_array_equal(again.landscape.values, motion.landscape.values)

    def test_truth_has_no_quality(self, make_motion, tmp_path):
        truth = make_motion(verdict="", residual=np.full(40, np.nan), truth=True)
        truth.save(tmp_path / "truth.h5")
        with h5py.File(tmp_path / "truth.h5") as file:
            assert "quality" not in file["motion"]
        again = Motion.load(tmp_path / "truth.h5")
        assert_same(truth, again)
        assert again.truth
        assert (again.valid == 1).all()
        assert (again.flags == 0).all()

    def test_rotations_keep_their_determinant(self, make_motion, tmp_path):
        make_motion(500).save(tmp_path / "a.h5")
        with h5py.File(tmp_path / "a.h5") as file:
            np.testing.assert_allclose(np.linalg.det(file["motion/rotation/R"][:]), 1, atol=1e-10)

    def test_names_that_are_no_text_can_be_stored(self, make_motion, tmp_path):
        name = os.fsdecode(b"bad\xffname\x00")
        make_motion(provenance={"inputs": name}).save(tmp_path / "a.h5")
        assert Motion.load(tmp_path / "a.h5").provenance["inputs"] == r"bad\udcffname\0"

    def test_one_frame(self, make_motion, tmp_path):
        make_motion(1).save(tmp_path / "a.h5")
        assert len(Motion.load(tmp_path / "a.h5")) == 1

    def test_str_paths(self, make_motion, tmp_path):
        make_motion().save(str(tmp_path / "a.h5"))
        assert len(Motion.load(str(tmp_path / "a.h5"))) == 40


class TestLayout:
    @pytest.fixture
    def file(self, motion, tmp_path):
        motion.save(tmp_path / "a.h5")
        with h5py.File(tmp_path / "a.h5") as file:
            yield file

    def test_quaternions_give_the_rotations(self, motion, file):
        q, known = file["motion/rotation/quaternion"][:], motion.valid == 1
        np.testing.assert_allclose(Rotation.from_quat(q[known]).as_matrix(), motion.R[known], atol=1e-14)
        assert np.isnan(q[~known]).all()

    def test_quaternion_signs_are_continuous_over_several_turns(self, make_motion, tmp_path):
        turns = Rotation.from_rotvec(np.outer(np.linspace(0, 30, 300), [0.6, 0, 0.8])).as_matrix()
        make_motion(300, R=turns).save(tmp_path / "turns.h5")
        with h5py.File(tmp_path / "turns.h5") as file:
            q = file["motion/rotation/quaternion"][:]
        assert (np.sum(q[1:] * q[:-1], axis=1) > 0).all()
        angle = np.linspace(0, 15, 300)
        np.testing.assert_allclose(
            q, np.stack([0.6 * np.sin(angle), 0 * angle, 0.8 * np.sin(angle), np.cos(angle)], 1), atol=1e-12
        )

    def test_every_dataset_says_its_unit(self, file):
        units = {name: node.attrs["units"] for name, node in walk(file) if isinstance(node, h5py.Dataset)}
        assert all(unit for name, unit in units.items() if not name.startswith("/motion/process/"))
        assert units["/motion/time"] == units["/motion/quality/time"] == "s"
        assert units["/motion/translation/T1_errors"] == units["/motion/translation/center2"] == "µm"
        assert units["/motion/angular_velocity/phi"] == "rad"
        assert units["/motion/angular_velocity/alpha"] == "rad/s"

    def test_rates_per_frame(self, make_motion, tmp_path):
        make_motion(time_unit="frame", length_unit="pixel").save(tmp_path / "b.h5")
        with h5py.File(tmp_path / "b.h5") as file:
            assert file["motion/angular_velocity/omega_3_errors"].attrs["units"] == "rad/frame"

    def test_viewers_find_a_curve_with_its_axis(self, file):
        """The NeXus way from the root to a plot: default, default, signal, axes; all series of length N."""
        assert file.attrs["NX_class"] == "NXroot"
        entry = file[file.attrs["default"]]
        assert entry.attrs["NX_class"] == "NXentry"
        assert entry[entry.attrs["default"]].attrs["NX_class"] == "NXdata"
        for name in ("translation", "angular_velocity", "rotation", "quality"):
            data = entry[name]
            assert data.attrs["NX_class"] == "NXdata"
            axis = data[data.attrs["axes"]]
            assert axis == entry["time"]
            for signal in (data.attrs["signal"], *data.attrs.get("auxiliary_signals", ())):
                assert data[signal].shape == axis.shape

    def test_series_have_one_dimension(self, file):
        for group in ("translation", "angular_velocity", "quality"):
            assert all(dataset.shape == (30,) for dataset in file["motion"][group].values())

    def test_landscape_is_an_nxdata_of_curves(self, file):
        data = file["motion/landscape"]
        assert data[data.attrs["signal"]].shape == tuple(len(data[axis]) for axis in data.attrs["axes"])
        assert data["Phi"].attrs["interpretation"] == "spectrum"

    def test_flag_meanings_cover_every_bit(self, file):
        meanings = file["motion/quality/flags"].attrs["meanings"]
        assert meanings.split("; ") == [f"{int(flag)}: {text}" for flag, text in FLAG_MEANINGS.items()]

    def test_verdict(self, file):
        assert file["motion/quality"].attrs["identifiable"] == False  # noqa: E712
        assert "symmetric" in file["motion/quality"].attrs["verdict"]

    def test_cartesian_components(self, motion, file):
        rates = file["motion/angular_velocity"]
        np.testing.assert_array_equal(rates["omega_1"][:], motion.alpha * np.cos(motion.phi))
        np.testing.assert_array_equal(rates["omega_2"][:], motion.alpha * np.sin(motion.phi))

    def test_format_is_the_documented_one(self, file):
        lines = [describe(name, node) for name, node in walk(file)]
        golden = Path(__file__).with_name("format-1.0.txt")
        assert "\n".join(lines) + "\n" == golden.read_text(encoding="utf-8")


def walk(node: h5py.Group | h5py.Dataset) -> Iterator[tuple[str, h5py.Group | h5py.Dataset]]:
    yield node.name, node
    if isinstance(node, h5py.Group):
        for child in node:
            yield from walk(node[child])


def describe(name: str, node: h5py.Group | h5py.Dataset) -> str:
    """One line for the golden file: path, shape and type, attributes."""
    kind = f" {node.shape} {node.dtype}" if isinstance(node, h5py.Dataset) else ""
    attributes = (f"{key}={np.asarray(node.attrs[key]).tolist()!r}" for key in sorted(node.attrs))
    return f"{name}{kind}  {', '.join(attributes)}"


class TestWriting:
    def test_existing_output_is_kept_without_overwrite(self, make_motion, tmp_path):
        path = tmp_path / "a.h5"
        path.write_text("precious")
        with pytest.raises(OutputError, match=r"a\.h5.*exists"):
            make_motion().save(path)
        assert path.read_text() == "precious"
        make_motion().save(path, overwrite=True)
        assert len(Motion.load(path)) == 40
        assert [p.name for p in tmp_path.iterdir()] == ["a.h5"]

    def test_target_is_a_folder(self, make_motion, tmp_path):
        with pytest.raises(OutputError, match="folder"):
            make_motion().save(tmp_path, overwrite=True)

    def test_missing_folder(self, make_motion, tmp_path):
        with pytest.raises(OutputError, match="nowhere"):
            make_motion().save(tmp_path / "nowhere" / "a.h5")

    def test_symlink_is_followed_and_kept(self, make_motion, tmp_path):
        (tmp_path / "real").mkdir()
        (tmp_path / "real" / "a.h5").write_text("old")
        link = tmp_path / "link.h5"
        link.symlink_to(tmp_path / "real" / "a.h5")
        with pytest.raises(OutputError, match="exists"):
            make_motion().save(link)
        make_motion().save(link, overwrite=True)
        assert link.is_symlink()
        assert len(Motion.load(tmp_path / "real" / "a.h5")) == 40

    @pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
    def test_read_only_folder(self, make_motion, tmp_path):
        folder = tmp_path / "locked"
        folder.mkdir(mode=0o500)
        with pytest.raises(OutputError, match="writable"):
            make_motion().save(folder / "a.h5")

    @pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs a file system that takes no files")
    def test_folder_that_takes_no_files(self, make_motion):
        with pytest.raises(OutputError, match=r"can't be written|not writable"):
            make_motion().save("/proc/a.h5")

    @pytest.mark.parametrize("limit", [0, 1000, 20_000])
    def test_full_disk(self, tmp_path, limit):
        """The system refuses to let the file grow: the old file stays, nothing else is left."""
        path = tmp_path / "a.h5"
        path.write_text("precious")
        script = PREPARE + (
            "import resource\n"
            f"resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}))\n"
            "try:\n"
            "    motion(1000).save(path, overwrite=True)\n"
            "except OutputError as error:\n"
            "    sys.stderr.write(str(error))\n"
            "    sys.exit(error.exit_code)\n"
        )
        run = subprocess.run(
            [sys.executable, "-c", script, str(path)], capture_output=True, text=True, check=False
        )
        assert run.returncode == 5, run.stderr
        assert re.fullmatch(r".*a\.h5: can't be written \(.+\)", run.stderr)
        assert path.read_text() == "precious"
        assert list(tmp_path.iterdir()) == [path]

    @pytest.mark.parametrize("kills", [20, pytest.param(200, marks=pytest.mark.slow)])
    def test_kill_never_leaves_a_broken_file(self, tmp_path, kills):
        """Children overwrite the result again and again until killed; it must be readable every time."""
        path = tmp_path / "a.h5"
        script = PREPARE + (
            "import os, random, signal, time\n"
            "m = motion(2000)\n"
            "m.save(path)\n"
            f"for kill in range({kills}):\n"
            "    child = os.fork()\n"
            "    if child == 0:\n"
            "        while True:\n"
            "            m.save(path, overwrite=True)\n"
            "    time.sleep(random.uniform(0, 0.03))\n"
            "    os.kill(child, signal.SIGKILL)\n"
            "    os.waitpid(child, 0)\n"
            "    assert len(Motion.load(path)) == 2000\n"
            "m.save(path, overwrite=True)\n"
        )
        subprocess.run([sys.executable, "-c", script, str(path)], check=True)
        assert list(tmp_path.iterdir()) == [path]


PREPARE = """
import sys
import numpy as np
from trapcli.errors import OutputError
from trapcli.result.motion import Motion

path = sys.argv[1]

def motion(n):
    zero = np.zeros(n)
    return Motion(
        time=np.arange(n, dtype=float), frame=np.arange(n), T=np.zeros((n, 2)), center=np.zeros((n, 2)),
        phi=zero, omega_3=zero, alpha=zero, R=np.tile(np.eye(3), (n, 1, 1)), T_errors=np.zeros((n, 2)),
        phi_errors=zero, omega_3_errors=zero, alpha_errors=zero, R_errors=np.zeros((n, 3)),
        valid=np.ones(n, np.uint8), flags=np.zeros(n, np.uint16), residual=zero,
    )

"""


class TestHostileFiles:
    """Whatever is in the file, reading ends soon with one line that names it."""

    @pytest.fixture
    def path(self, motion, tmp_path):
        motion.save(tmp_path / "a.h5")
        return tmp_path / "a.h5"

    @staticmethod
    def refused(path: Path, match: str) -> None:
        with pytest.raises(InputError, match=match) as caught:
            Motion.load(path)
        message = str(caught.value)
        assert str(path) in message
        assert "\n" not in message

    def test_missing(self, tmp_path):
        self.refused(tmp_path / "none.h5", "no such file")

    def test_folder(self, tmp_path):
        self.refused(tmp_path, "not a file")

    def test_pipe(self, tmp_path):
        os.mkfifo(tmp_path / "pipe")
        self.refused(tmp_path / "pipe", "not a file")

    @pytest.mark.parametrize("content", [b"", b"frame,time\n", b"\x89HDF\r\n\x1a\n" + bytes(100)])
    def test_no_hdf5(self, tmp_path, content):
        (tmp_path / "a.h5").write_bytes(content)
        self.refused(tmp_path / "a.h5", "not a readable HDF5 file")

    @pytest.mark.skipif(os.geteuid() == 0, reason="root may read anything")
    def test_no_permission(self, path):
        path.chmod(0)
        self.refused(path, "permission")

    def test_other_hdf5(self, tmp_path):
        with h5py.File(tmp_path / "other.h5", "w") as file:
            file["data"] = [1, 2]
        self.refused(tmp_path / "other.h5", "not a result of trap-motion")

    @pytest.mark.parametrize("share", np.arange(0.05, 1, 0.05))
    def test_truncated(self, path, share):
        whole = path.read_bytes()
        path.write_bytes(whole[: int(share * len(whole))])
        self.refused(path, "HDF5|/motion|not a result")

    def test_incomplete(self, path):
        with h5py.File(path, "r+") as file:
            del file["motion"].attrs["complete"]
        self.refused(path, "incomplete")

    def test_newer_format(self, path):
        with h5py.File(path, "r+") as file:
            file.attrs["format_version"] = "2.0"
        self.refused(path, "2.0")

    @pytest.mark.parametrize(
        "name",
        [
            "time",
            "frame",
            "translation",
            "translation/T2",
            "rotation/R",
            "quality/flags",
            "process",
            "angular_velocity/phi_errors",
        ],
    )
    def test_missing_parts(self, path, name):
        with h5py.File(path, "r+") as file:
            del file["motion"][name]
        self.refused(path, f"lacks /motion/{name}")

    @pytest.mark.parametrize(
        ("name", "value"),
        [
            ("translation/T1", np.zeros(29)),
            ("rotation/R", np.zeros((30, 9))),
            ("quality/valid", np.zeros((30, 1), np.uint8)),
            ("frame", np.zeros(30)),
            ("angular_velocity/phi", np.zeros(30, "S3")),
            ("angular_velocity/alpha", np.zeros(30, complex)),
            ("time", np.full(30, np.nan)),
            ("time", np.zeros(0)),
            ("time", np.zeros(30)),
            ("time", np.linspace(0, 1e300, 30)),
            ("time", 3.0),
            ("rotation/R", np.zeros((30, 3, 3))),
            ("rotation/R", np.full((30, 3, 3), 1e200)),
            ("rotation/R", np.tile(np.diag([1.0, 1.0, -1.0]), (30, 1, 1))),
            ("process/program", 7),
            ("process/program", np.array(["a", "b"], dtype=h5py.string_dtype())),
            ("landscape/Phi", np.zeros((2, 8))),
            ("landscape/Phi", np.zeros(9)),
            ("landscape/Phi", np.zeros((0, 9))),
        ],
    )
    def test_wrong_shapes_types_and_values(self, path, name, value):
        with h5py.File(path, "r+") as file:
            del file["motion"][name]
            file["motion"][name] = value
            file["motion"][name].attrs["units"] = "s"
        self.refused(path, "/motion/" + name.split("/")[0])

    @pytest.mark.parametrize("chunks", [None, True])
    def test_eight_terabytes_are_not_read(self, path, chunks):
        with h5py.File(path, "r+") as file:
            for name in ("time", "translation/T1"):
                del file["motion"][name]
                file["motion"].create_dataset(name, shape=(10**12,), dtype="f8", chunks=chunks).attrs[
                    "units"
                ] = "s"
        self.refused(path, "1000000000000 frames")

    def test_unallocated_values_are_not_made_up(self, path):
        with h5py.File(path, "r+") as file:
            del file["motion/time"]
            file["motion"].create_dataset("time", shape=(10**6,), dtype="f8").attrs["units"] = "s"
        self.refused(path, "more than the file has")

    def test_external_storage(self, path, tmp_path):
        secret = tmp_path / "secret"
        secret.write_bytes(b"x" * 240)
        with h5py.File(path, "r+") as file:
            del file["motion/translation/T1"]
            file["motion/translation"].create_dataset("T1", (30,), "f8", external=[(str(secret), 0, 240)])
        self.refused(path, "other files")

    def test_virtual_dataset(self, path):
        with h5py.File(path, "r+") as file:
            del file["motion/translation/T1"]
            layout = h5py.VirtualLayout((30,), "f8")
            layout[:] = h5py.VirtualSource(str(path), "/motion/time", (30,))
            file["motion/translation"].create_virtual_dataset("T1", layout)
        self.refused(path, "other files")

    @pytest.mark.parametrize(
        "name", ["motion", "motion/translation", "motion/translation/T1", "motion/process/program"]
    )
    @pytest.mark.parametrize("kind", ["soft loop", "external"])
    def test_links(self, path, name, kind):
        with h5py.File(path, "r+") as file:
            del file[name]
            file[name] = (
                h5py.SoftLink("/" + name) if kind == "soft loop" else h5py.ExternalLink("/etc/passwd", "/")
            )
        self.refused(path, "link")

    def test_group_in_place_of_dataset(self, path):
        with h5py.File(path, "r+") as file:
            del file["motion/time"]
            file.create_group("motion/time")
        self.refused(path, "kind")

    def test_recompressed_files_are_read(self, path, motion):
        """As ``h5repack -f GZIP=9`` leaves them."""
        with h5py.File(path, "r+") as file:
            for name in ("R", "angle"):
                dataset = file["motion/rotation"][name]
                values, attributes = dataset[()], dict(dataset.attrs)
                del file["motion/rotation"][name]
                again = file["motion/rotation"].create_dataset(name, data=values, compression="gzip")
                again.attrs.update(attributes)
        assert_same(motion, Motion.load(path))

    def test_texts_that_would_hang_the_library(self, path):
        """The free space at the end of the heap of texts claims to have no size."""
        content = bytearray(path.read_bytes())
        entry = content.index(b"GCOL") + 16
        while content[entry : entry + 2] != b"\0\0":
            entry += 16 + -(-int.from_bytes(content[entry + 8 : entry + 16], "little") // 8) * 8
        content[entry + 8 : entry + 16] = bytes(8)
        path.write_bytes(content)
        self.refused(path, "damaged texts")

    @pytest.mark.parametrize("seeds", [range(150), pytest.param(range(150, 5000), marks=pytest.mark.slow)])
    def test_flipped_bytes(self, path, tmp_path, seeds):
        """Only our own errors escape; a flip in the numbers goes unnoticed."""
        whole = np.frombuffer(path.read_bytes(), np.uint8)
        for seed in seeds:
            rng = np.random.default_rng(seed)
            flipped = whole.copy()
            where = rng.integers(len(whole), size=rng.integers(1, 30))
            flipped[where] = rng.integers(256, size=len(where))
            path.write_bytes(flipped.tobytes())
            try:
                Motion.load(path)
            except InputError:
                continue
