"""Exports read by the programs they are for, where these are installed; all run on the processor alone.

``pip install starfile odtbrain astra-toolbox aspire`` brings them.
"""

from __future__ import annotations

import io

import numpy as np
import pytest

from trapcli.reconstruction.alignment import align
from trapcli.reconstruction.geometry import Detector, angle_blocks, astra_blocks, relion_blocks
from trapcli.reconstruction.single_axis import require_single_axis
from trapcli.reconstruction.volume_files import write_mrc, write_mrc_stack

SIZE, FRAMES = 48, 60

pytestmark = [
    pytest.mark.slow,
    # what other programs warn of is not ours to judge
    pytest.mark.filterwarnings("default"),
]


def detector(case, name="frames.tif", center=None):
    center = case.motion.center / case.pixel_size if center is None else center
    return Detector(name, (SIZE, SIZE), case.pixel_size, "µm", center)


def aligned(case, turn=0.0):
    return align(case.frames, case.motion.center / case.pixel_size, turn=turn)


@pytest.fixture
def tumbling(example):
    return example("tumbling", frames=FRAMES, size=SIZE, total_angle=480.0)


@pytest.fixture
def down(example):
    """The axis runs down the image."""
    return example("single-axis", frames=FRAMES, size=SIZE, azimuth=90.0)


def test_starfile_reads_the_particles(tumbling, tmp_path):
    starfile = pytest.importorskip("starfile", reason="starfile isn't installed")
    path = tmp_path / "a.star"
    path.write_text("".join(relion_blocks(tumbling.motion, detector(tumbling, "a.mrcs"))))
    tables = starfile.read(path)
    particles = tables["particles"]
    assert len(particles) == FRAMES
    assert particles["rlnImageName"][7] == "000008@a.mrcs"
    origin = particles[["rlnOriginXAngst", "rlnOriginYAngst"]].to_numpy() / 1e4
    np.testing.assert_allclose(origin, -tumbling.motion.center, atol=1e-6)


def test_aspire_projects_the_object_onto_the_frames(tumbling, tmp_path):
    """ASPIRE reads images and angles as RELION does, and projects a volume by them."""
    source = pytest.importorskip("aspire.source", reason="ASPIRE isn't installed")
    volume = pytest.importorskip("aspire.volume")
    frames = aligned(tumbling)
    shape = (FRAMES, SIZE, SIZE)
    write_mrc_stack(tmp_path / "a.mrcs", frames.blocks(), shape, tumbling.pixel_size, "µm")
    there = detector(tumbling, "a.mrcs", np.zeros((FRAMES, 2)))
    (tmp_path / "a.star").write_text("".join(relion_blocks(tumbling.motion, there)))
    true = tumbling.volume(SIZE, tumbling.pixel_size).astype(np.float32)
    write_mrc(tmp_path / "true.mrc", true, tumbling.pixel_size, "µm")
    read = source.RelionSource(str(tmp_path / "a.star"), data_folder=str(tmp_path))
    images = read.images[:].asnumpy()
    shown = volume.Volume.load(str(tmp_path / "true.mrc")).project(read.rotations).asnumpy()
    # ASPIRE's projections are means along the rays
    shown = shown * SIZE * tumbling.pixel_size
    np.testing.assert_allclose(shown, images, atol=0.02 * images.max())


def test_astra_projects_the_object_onto_the_frames(down):
    """Without a graphics card ASTRA projects planes only: here those across the axis, x₂ = const."""
    astra = pytest.importorskip("astra", reason="the ASTRA toolbox isn't installed")
    frames = np.asarray(down.frames.to_array())
    rows = np.loadtxt(io.StringIO("".join(astra_blocks(down.motion, detector(down)))))
    geometry = astra.create_proj_geom("parallel3d_vec", SIZE, SIZE, rows[:, 1:])
    assert tuple(astra.geom_size(geometry)) == (SIZE, FRAMES, SIZE)
    ray, middle, column, row = rows[:, 1:].reshape(-1, 4, 3).swapaxes(0, 1)
    np.testing.assert_allclose(row, np.tile([0, 1, 0], (FRAMES, 1)), atol=1e-9)
    vectors = np.concatenate([ray[:, [0, 2]], middle[:, [0, 2]], column[:, [0, 2]]], axis=1)
    fine = 4
    n = fine * SIZE
    edges = [(-(n // 2) - 0.5) / fine, (n - n // 2 - 0.5) / fine] * 2
    plane = astra.create_vol_geom(n, n, *edges)
    projector = astra.create_projector("linear", astra.create_proj_geom("parallel_vec", SIZE, vectors), plane)
    x = (np.arange(n) - n // 2) / fine
    worst = 0.0
    for frame in range(0, FRAMES, 9):
        for line in range(8, SIZE - 8, 8):
            x2 = middle[frame, 1] + line - (SIZE - 1) / 2
            x3, x1 = np.meshgrid(x, x, indexing="ij")
            points = np.stack([x1, np.full_like(x1, x2), x3], axis=-1)
            # planes of ASTRA begin at the highest y
            density = down.density(points * down.pixel_size)[::-1] * down.pixel_size
            number, sinogram = astra.create_sino(density.astype(np.float32), projector)
            astra.data2d.delete(number)
            worst = max(worst, float(np.abs(sinogram[frame] - frames[frame, line]).max()))
    astra.projector.delete(projector)
    assert worst < 0.01 * frames.max()


def test_odtbrain_finds_the_object(down):
    odtbrain = pytest.importorskip("odtbrain", reason="ODTbrain isn't installed")
    turn = np.pi / 2 - require_single_axis(down.motion.R).azimuth
    frames = np.asarray(aligned(down, turn).to_array(), float)
    text = "".join(angle_blocks(down.motion, sign=-1, program="ODTbrain"))
    frame, angle = np.loadtxt(io.StringIO(text), unpack=True)
    # a wavelength much shorter than a pixel: light goes straight
    found = odtbrain.backpropagate_3d(
        1j * frames[frame.astype(int)], angle, res=0.2, nm=1.33, num_cores=1
    ).real
    true = down.volume(SIZE, down.pixel_size)
    assert best_correlation(found, true) > 0.9
    for flipped in (true[::-1], true[:, ::-1], true[:, :, ::-1], true.swapaxes(0, 2)):
        assert best_correlation(found, flipped) < 0.85


def best_correlation(a, b):
    """Over shifts by up to a voxel: ODTbrain's axis lies between pixels."""
    a, b = ((values - values.mean()) / values.std() for values in (a, b))
    spectrum = np.fft.fftn(a) * np.fft.fftn(b).conj()
    correlation = np.fft.ifftn(spectrum).real / a.size
    return max(correlation[i, j, k] for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1))
