"""The result file: `Motion` as HDF5 in NeXus base classes, written atomically and read with suspicion.

The file is built in memory and written in one piece, so that a full disk is an ordinary `OSError`.
``docs/formats.md`` describes every dataset.
"""

from __future__ import annotations

import mmap
import struct
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from trapcli.atomic import atomic_path
from trapcli.errors import InputError, OutputError
from trapcli.result.motion import FLAG_MEANINGS, Array, Landscape, Motion

FORMAT = "trap-motion"
FORMAT_VERSION = "1.0"
CONVENTION = (
    "R takes lab to object coordinates, A(t, x) = C3 + R(t) (x - C3 + T(t)); R is 1 at the first frame; "
    "R^T dR/dt x = omega cross x with omega in lab axes; lab axes: x1 to the right along columns, "
    "x2 downwards along rows, x3 away from the viewer"
)
QUATERNION_CONVENTION = "(x, y, z, w), scalar last, of R; signs are continuous in time"
ERRORS_CONVENTION = "standard deviation of the rotation vector d in R_true = R exp([d]x), d in lab axes"

_MAX_BYTES = 2 << 30
"""Most memory that the arrays of a result may claim."""
_ROW_BYTES = 8 * 32
"""Memory of one frame, all series together."""
_MAX_TEXT = 16 << 20
_END_OF_TIME = 1e100
_TEXT = h5py.string_dtype()
_HEAP_SIGNATURE = b"GCOL\x01"
_HEAP_SIZE = struct.Struct("<Q")
_HEAP_ENTRY = struct.Struct("<H6xQ")
_HDF5_ERRORS = (OSError, RuntimeError, ValueError, KeyError, TypeError, OverflowError, MemoryError)
"""What h5py raises on files that are damaged or not what they seem."""


def save(motion: Motion, path: Path, *, overwrite: bool = False) -> None:
    """Write `motion` to `path`; after a failure or a kill `path` is what it was before.

    Parameters
    ----------
    overwrite:
        Replace an existing file.

    Raises
    ------
    OutputError
        Where the file exists and `overwrite` is false, or can't be written.
    """
    image = _image(motion)
    with atomic_path(path, overwrite) as temporary:
        temporary.write_bytes(image)
        try:
            load(temporary)
        except InputError as error:
            raise OutputError(f"{path}: can't be read back after writing ({error}); check the disk") from None


def load(path: Path) -> Motion:
    """Read a result or truth file.

    Frames of a truth file, which has no ``/motion/quality``, are all valid. Nothing is read before its shape
    is known to be the expected one and to fit into the file and the memory; links out of it are refused.

    Raises
    ------
    InputError
        Where the file is missing, damaged, incomplete or not a result of trap-motion.
    """
    try:
        if not path.is_file():
            raise InputError(f"{path}: {'not a file' if path.exists() else 'no such file'}")
        _check_heaps(path)
        with h5py.File(path, "r", locking=False) as file:
            return _Reader(path, file).motion()
    except PermissionError:
        raise InputError(f"{path}: no permission to read it") from None
    except _HDF5_ERRORS as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"{path}: not a readable HDF5 file ({reason})") from None


def quaternions(R: Array) -> Array:
    """Return ``(N, 4)`` quaternions of ``(N, 3, 3)`` rotations, scalar last, signs continuous."""
    quaternion = np.full((len(R), 4), np.nan)
    known = np.isfinite(R).all(axis=(1, 2))
    if known.any():
        q = Rotation.from_matrix(R[known]).as_quat(canonical=True)
        turns = np.sum(q[1:] * q[:-1], axis=1) < 0
        q[1:] *= np.where(np.cumsum(turns) % 2, -1.0, 1.0)[:, None]
        quaternion[known] = q
    return quaternion


def rotation_angles(R: Array) -> Array:
    """Return the angle ``(N,)`` of each rotation ``(N, 3, 3)``, in [0, π] rad; NaN stays NaN."""
    angle = np.full(len(R), np.nan)
    known = np.isfinite(R).all(axis=(1, 2))
    if known.any():
        angle[known] = Rotation.from_matrix(R[known]).magnitude()
    return angle


# writing


def _image(motion: Motion) -> bytes:
    # from version 1.8 of the format on, checksums tell damaged metadata, which can crash or hang the library
    versions = ("v108", "v108")
    with h5py.File("result", "w", driver="core", backing_store=False, libver=versions) as file:
        file.attrs.update(NX_class="NXroot", default="motion", format=FORMAT, format_version=FORMAT_VERSION)
        entry = _group(file, "motion", "NXentry", default="angular_velocity")
        rate = f"rad/{motion.time_unit}"
        time = _put(entry, "time", motion.time, motion.time_unit, "time")
        time.attrs["target"] = "/motion/time"
        _put(entry, "frame", motion.frame.astype(np.int64), "frame", "index in the input")

        group = _data(entry, "translation", ("T1", "T2"))
        for i in (0, 1):
            name = f"T{i + 1}"
            _put(group, name, motion.T[:, i], motion.length_unit, name)
            _put(group, f"{name}_errors", motion.T_errors[:, i], motion.length_unit)
            _put(group, f"center{i + 1}", motion.center[:, i], motion.length_unit)

        group = _data(entry, "angular_velocity", ("phi", "omega_3", "alpha"))
        for name, unit, label in (("phi", "rad", "φ"), ("omega_3", rate, "ω₃"), ("alpha", rate, "α")):
            _put(group, name, getattr(motion, name), unit, label)
            _put(group, f"{name}_errors", getattr(motion, f"{name}_errors"), unit)
        _put(group, "omega_1", motion.omega_1, rate, "ω₁")
        _put(group, "omega_2", motion.omega_2, rate, "ω₂")

        group = _data(entry, "rotation", ("angle",))
        _put(group, "angle", rotation_angles(motion.R), "rad", "turn since the first frame")
        _put(group, "R", motion.R, "1").attrs["convention"] = CONVENTION
        _put(group, "quaternion", quaternions(motion.R), "1").attrs["convention"] = QUATERNION_CONVENTION
        for i in (0, 1, 2):
            dataset = _put(group, f"R{i + 1}_errors", motion.R_errors[:, i], "rad")
            dataset.attrs["convention"] = ERRORS_CONVENTION

        if not motion.truth:
            _put_quality(entry, motion)
        if motion.landscape is not None:
            _put_landscape(entry, motion.landscape)
        process = _group(entry, "process", "NXprocess")
        for name, text in motion.provenance.items():
            process.create_dataset(name, data=_clean(text), dtype=_TEXT).attrs["units"] = ""
        entry.attrs["complete"] = True
        file.flush()
        return bytes(file.id.get_file_image())


def _put_quality(entry: h5py.Group, motion: Motion) -> None:
    group = _data(entry, "quality", ("residual",))
    group.attrs["identifiable"] = np.bool_(motion.identifiable)
    group.attrs["verdict"] = _clean(motion.verdict)
    _put(group, "valid", motion.valid.astype(np.uint8), "1")
    flags = _put(group, "flags", motion.flags.astype(np.uint16), "1")
    flags.attrs["meanings"] = "; ".join(f"{int(flag)}: {meaning}" for flag, meaning in FLAG_MEANINGS.items())
    _put(group, "residual", motion.residual, "1", "relative misfit")


def _put_landscape(entry: h5py.Group, landscape: Landscape) -> None:
    group = _group(entry, "landscape", "NXdata", signal="Phi")
    group.attrs["axes"] = np.array(["frame", "phi"], dtype=_TEXT)
    # "spectrum" asks viewers for one curve a frame in place of an image
    _put(group, "Phi", landscape.values, "1", "Φ").attrs["interpretation"] = "spectrum"
    _put(group, "phi", landscape.phi, "rad", "φ")
    _put(group, "frame", landscape.frame.astype(np.int64), "frame", "index in the input")


def _group(parent: h5py.Group, name: str, nx_class: str, **attributes: str) -> h5py.Group:
    group = parent.create_group(name)
    group.attrs.update(NX_class=nx_class, **attributes)
    return group


def _data(entry: h5py.Group, name: str, signals: tuple[str, ...]) -> h5py.Group:
    group = _group(entry, name, "NXdata", signal=signals[0], axes="time")
    if signals[1:]:
        group.attrs["auxiliary_signals"] = np.array(signals[1:], dtype=_TEXT)
    group["time"] = entry["time"]
    return group


def _put(group: h5py.Group, name: str, values: NDArray[Any], unit: str, label: str = "") -> h5py.Dataset:
    dataset = group.create_dataset(name, data=values)
    dataset.attrs["units"] = unit
    if label:
        dataset.attrs["long_name"] = label if unit in ("1", "frame") else f"{label} ({unit})"
    return dataset


def _clean(text: str) -> str:
    """Make a text storable: file names may hold bytes that are no UTF-8, and HDF5 strings end at a NUL."""
    return text.replace("\0", "\\0").encode("utf-8", "backslashreplace").decode()


# reading


def _check_heaps(path: Path) -> None:
    """Refuse damaged global heaps (which hold the texts): the HDF5 library would loop over them for ever."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        heap, previous_end = content.find(_HEAP_SIGNATURE), 0
        while 0 <= heap <= len(content) - 16:
            end = heap + _HEAP_SIZE.unpack_from(content, heap + 8)[0]
            if end <= len(content):  # the library itself refuses what goes on beyond the file
                if heap < previous_end or not _heap_ends(content, heap + 16, end):
                    raise ValueError("damaged texts")
                previous_end = end
            heap = content.find(_HEAP_SIGNATURE, heap + 16)


def _heap_ends(content: mmap.mmap, entry: int, end: int) -> bool:
    while entry + 16 <= end:
        index, size = _HEAP_ENTRY.unpack_from(content, entry)
        # the size of free space (index 0) counts its own header, that of a text doesn't
        step = size if index == 0 else 16 + -(-size // 8) * 8
        if step < 16:
            return False
        entry += step
    return True


class _Reader:
    """Reads one open file; every check names the file and the dataset."""

    def __init__(self, path: Path, file: h5py.File) -> None:
        self.path = path
        self.file = file
        self.size = path.stat().st_size

    def motion(self) -> Motion:
        self._check_format()
        time_shape, time_unit = self._shape("motion/time"), self._unit("motion/time")
        if len(time_shape) != 1 or time_shape[0] < 1:
            raise self._error("/motion/time holds no frames")
        n = time_shape[0]
        if n * _ROW_BYTES > _MAX_BYTES:
            raise self._error(f"claims {n} frames, more than fit into memory")

        def series(name: str, *tail: int) -> Array:
            return self._numbers(f"motion/{name}", (n, *tail)).astype(np.float64)

        def pair(name: str, suffix: str = "") -> Array:
            return np.stack([series(f"translation/{name}{i}{suffix}") for i in (1, 2)], axis=1)

        time, R = series("time"), series("rotation/R", 3, 3)
        self._check_values(time, R)
        truth = not self._has("motion", "quality")
        return Motion(
            time=time,
            frame=self._numbers("motion/frame", (n,), "iu").astype(np.int64),
            T=pair("T"),
            T_errors=pair("T", "_errors"),
            center=pair("center"),
            phi=series("angular_velocity/phi"),
            phi_errors=series("angular_velocity/phi_errors"),
            omega_3=series("angular_velocity/omega_3"),
            omega_3_errors=series("angular_velocity/omega_3_errors"),
            alpha=series("angular_velocity/alpha"),
            alpha_errors=series("angular_velocity/alpha_errors"),
            R=R,
            R_errors=np.stack([series(f"rotation/R{i}_errors") for i in (1, 2, 3)], axis=1),
            valid=np.ones(n, np.uint8)
            if truth
            else self._numbers("motion/quality/valid", (n,), "iu").astype(np.uint8),
            flags=np.zeros(n, np.uint16)
            if truth
            else self._numbers("motion/quality/flags", (n,), "iu").astype(np.uint16),
            residual=np.full(n, np.nan) if truth else series("quality/residual"),
            identifiable=truth or bool(self._attribute("motion/quality", "identifiable", True)),
            verdict="" if truth else str(self._attribute("motion/quality", "verdict", "")),
            truth=truth,
            time_unit=time_unit,
            length_unit=self._unit("motion/translation/T1"),
            landscape=self._landscape() if self._has("motion", "landscape") else None,
            provenance=self._provenance(),
        )

    def _check_format(self) -> None:
        if self._attribute("", "format", "") != FORMAT:
            raise self._error("not a result of trap-motion")
        version = str(self._attribute("", "format_version", ""))
        if version.split(".")[0] != FORMAT_VERSION.split(".")[0]:
            raise self._error(
                f"has format version {version!r}, this program reads {FORMAT_VERSION}; update it"
            )
        if not self._attribute("motion", "complete", False):
            raise self._error("incomplete: its writing was interrupted; estimate again")

    def _check_values(self, time: Array, R: Array) -> None:
        if not (np.abs(time) < _END_OF_TIME).all() or not (np.diff(time) > 0).all():
            raise self._error("/motion/time holds values that are no increasing times")
        known = R[np.isfinite(R).all(axis=(1, 2))]
        with np.errstate(over="ignore", invalid="ignore"):
            orthogonal = np.abs(known.transpose(0, 2, 1) @ known - np.eye(3)) < 1e-6
        if not orthogonal.all() or not (np.linalg.det(known) > 0).all():
            raise self._error("/motion/rotation/R holds matrices that are no rotations")

    def _landscape(self) -> Landscape:
        shape = self._shape("motion/landscape/Phi")
        if len(shape) != 2 or not 0 < shape[0] * shape[1] * 8 <= _MAX_BYTES:
            raise self._error(f"/motion/landscape/Phi has the shape {shape}, which can't be")
        return Landscape(
            phi=self._numbers("motion/landscape/phi", shape[1:]).astype(np.float64),
            frame=self._numbers("motion/landscape/frame", shape[:1], "iu").astype(np.int64),
            values=self._numbers("motion/landscape/Phi", shape).astype(np.float64),
        )

    def _provenance(self) -> dict[str, str]:
        group = self._object("motion/process", h5py.Group)
        texts = {}
        for name in group:
            dataset = self._dataset(f"motion/process/{name}")
            if dataset.shape != () or h5py.check_string_dtype(dataset.dtype) is None:
                raise self._error(f"/motion/process/{name} is no text")
            if dataset.dtype.itemsize > _MAX_TEXT:
                raise self._error(f"/motion/process/{name} is too long for a text")
            texts[str(name)] = str(dataset.asstr(errors="replace")[()])
        return texts

    def _numbers(self, name: str, shape: tuple[int, ...], kinds: str = "fiu") -> NDArray[Any]:
        dataset = self._dataset(name)
        if dataset.shape != shape:
            raise self._error(f"/{name} has the shape {dataset.shape}, expected {shape}")
        if dataset.dtype.kind not in kinds or dataset.dtype.itemsize > 8:
            raise self._error(f"/{name} is of type {dataset.dtype}, expected numbers")
        if dataset.chunks is None and dataset.nbytes > self.size:
            raise self._error(
                f"/{name} claims {dataset.nbytes} bytes, more than the file has; it is truncated"
            )
        values: NDArray[Any] = dataset[()]
        return values

    def _shape(self, name: str) -> tuple[int, ...]:
        return tuple(self._dataset(name).shape or ())

    def _unit(self, name: str) -> str:
        unit = self._attribute(name, "units", "")
        if not isinstance(unit, str) or not unit:
            raise self._error(f"/{name} has no units")
        return unit

    def _attribute(self, name: str, attribute: str, default: Any) -> Any:
        attributes = (self._object(name, (h5py.Group, h5py.Dataset)) if name else self.file).attrs
        if attribute not in attributes:
            return default
        stored = attributes.get_id(attribute)
        if stored.shape != () or (
            stored.dtype.kind not in "bui" and not h5py.check_string_dtype(stored.dtype)
        ):
            raise self._error(f"attribute {attribute} of /{name} is neither a number nor a text")
        value = attributes[attribute]
        return value.decode("utf-8", "replace") if isinstance(value, bytes) else value

    def _dataset(self, name: str) -> h5py.Dataset:
        dataset = self._object(name, h5py.Dataset)
        if dataset.external or dataset.is_virtual:
            raise self._error(f"/{name} keeps its values in other files, which isn't accepted")
        return dataset

    def _object(self, name: str, kind: Any) -> Any:
        """Follow `name` from the root through hard links only."""
        node = self.file
        *parents, last = name.split("/")
        for part in parents:
            node = self._child(node, part, name, h5py.Group)
        return self._child(node, last, name, kind)

    def _child(self, group: h5py.Group, part: str, name: str, kind: Any) -> Any:
        link = group.get(part, getlink=True)
        if link is None:
            raise self._error(f"lacks /{name}")
        if not isinstance(link, h5py.HardLink):
            raise self._error(f"/{name} is a link to elsewhere, which isn't accepted")
        child = group[part]
        if not isinstance(child, kind):
            raise self._error(f"/{name} isn't of the expected kind")
        return child

    def _has(self, group: str, name: str) -> bool:
        return self._object(group, h5py.Group).get(name, getlink=True) is not None

    def _error(self, what: str) -> InputError:
        return InputError(f"{self.path}: {what}")
