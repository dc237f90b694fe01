"""A particle that turns in its place, before uneven light with specks: closed form everywhere."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from trapcli.preprocess import specks
from trapcli.preprocess.counts import Counts, Sample
from trapcli.preprocess.surface import EmptyField, median_field
from trapcli.preprocess.surface import fit_empty_field as fit_to_sample

SIZE, FRAMES = 96, 64
ROWS, COLUMNS = np.mgrid[:SIZE, :SIZE] - SIZE // 2
NOISE = 0.005


def ellipse() -> np.ndarray:
    """Attenuation of an ellipsoid with two inclusions, turning in the middle about the optical axis."""
    turn = np.linspace(0, 3 * np.pi, FRAMES)[:, None, None]
    x1 = np.cos(turn) * COLUMNS + np.sin(turn) * ROWS
    x2 = np.cos(turn) * ROWS - np.sin(turn) * COLUMNS
    thickness = np.sqrt(np.maximum(1 - (x1 / 30) ** 2 - (x2 / 22) ** 2, 0))
    for at, size in (((12, 4), 7), ((-9, -6), 9)):
        thickness += 0.7 * np.sqrt(np.maximum(1 - ((x1 - at[0]) ** 2 + (x2 - at[1]) ** 2) / size**2, 0))
    return np.asarray(0.3 * thickness)


def uneven() -> np.ndarray:
    x1, x2 = COLUMNS / SIZE * 2, ROWS / SIZE * 2
    return np.asarray(9.0 + 0.1 * x1 - 0.05 * x2 + np.log(1 - 0.15 * (x1**2 + x2**2)))


def speck(row: int, column: int, size: float = 1.5, depth: float = 0.4) -> np.ndarray:
    square = (ROWS - row) ** 2 + (COLUMNS - column) ** 2
    return np.asarray(np.log(1 - depth * np.exp(-square / (2 * size**2))))


def stack(field: np.ndarray, light: np.ndarray | float = 0.0) -> np.ndarray:
    noise = NOISE * np.random.default_rng(1).standard_normal((FRAMES, SIZE, SIZE))
    return (field + light - ellipse() + noise).astype(np.float32)


def fit_empty_field(logs: np.ndarray) -> EmptyField:
    return fit_to_sample(Sample(Counts(0.0, np.inf), np.exp(logs)))


def deviation(found: np.ndarray, field: np.ndarray) -> np.ndarray:
    """Return the error but for its mean, which is the brightness of the frames."""
    free = np.hypot(ROWS, COLUMNS) > 40
    return np.asarray(found - field - (found - field)[free].mean())


def test_smooth_light_is_carried_on_under_the_particle() -> None:
    flicker = 0.05 * np.sin(7 * np.arange(FRAMES))[:, None, None]
    found = fit_empty_field(stack(uneven(), flicker))
    assert np.abs(deviation(found.log_light, uneven())).max() < 0.5 * NOISE
    assert found.outside[SIZE // 2, SIZE // 2] == 0
    assert found.outside[:5].min() == 1


@pytest.mark.parametrize("place", [(0, 3), (14, -10), (-33, -33)], ids=["middle", "inside", "outside"])
def test_specks_are_found_under_the_particle_and_beside_it(place: tuple[int, int]) -> None:
    field = uneven() + speck(*place)
    found = fit_empty_field(stack(field))
    assert found.specks == (np.hypot(*place) < 30)  # those beside it don't count
    error = deviation(found.log_light, field)
    around = np.hypot(ROWS - place[0], COLUMNS - place[1]) < 9
    assert abs(error[around].sum()) < 0.1 * abs(speck(*place).sum())
    assert np.abs(error).max() < 0.1 * np.abs(speck(*place)).max()


def test_the_particle_itself_is_no_speck() -> None:
    assert fit_empty_field(stack(uneven())).specks == 0


def test_steady_light_is_not_tilted() -> None:
    assert not fit_empty_field(stack(uneven())).light.tilted


def test_light_that_tilts_is_followed() -> None:
    frames = stack(uneven(), 0.02 * np.sin(np.arange(FRAMES) / 5)[:, None, None] * COLUMNS / (SIZE / 2))
    found = fit_empty_field(frames)
    assert found.light.tilted
    evened, _ = found.light.even(frames - found.log_light)
    free = np.hypot(ROWS, COLUMNS) > 40
    slopes = evened[:, free] @ COLUMNS[free] / np.sum(COLUMNS[free] ** 2)
    assert np.abs(slopes).max() * SIZE / 2 < 0.001


def test_pixels_that_tell_nothing_do_no_harm() -> None:
    frames = stack(uneven())
    frames[:, 3:6, 40:44] = np.nan
    frames[5, 50:60, 50:60] = np.nan
    found = fit_empty_field(frames)
    assert np.abs(deviation(found.log_light, uneven())).max() < 0.6 * NOISE


def test_specks_close_together_are_told_apart() -> None:
    field = uneven() + speck(2, 3) + speck(9, 5, size=2.2, depth=0.3) + speck(-14, 12, size=0.9, depth=0.2)
    found = fit_empty_field(stack(field))
    assert found.specks == 3
    assert np.abs(deviation(found.log_light, field)).max() < 0.07


def test_a_fit_follows_a_speck_that_lies_further_than_it_looked() -> None:
    noise = NOISE * np.random.default_rng(5).standard_normal((FRAMES, SIZE, SIZE))
    standing = specks.Standing.of((speck(4, -3) + noise).astype(np.float32), NOISE)
    place = np.array([4.0, -3.0]) + SIZE // 2
    off = place + np.array([0.0, 3.0])
    found = specks._fit(standing, off, [], [], off[None])
    assert found is not None
    np.testing.assert_allclose(found[0], [*place, 1.5, 0.4], atol=0.02)
    # where there is one already, there is no other
    assert specks._fit(standing, off, found, [0], off[None]) is None


def test_a_speck_under_a_round_particle_whose_mean_is_a_dome() -> None:
    """What turns is round: its mean in time is as curved as each frame is, and varies little."""
    turn = np.linspace(0, 3 * np.pi, FRAMES)[:, None, None]
    dome = np.sqrt(np.maximum(1 - (ROWS**2 + COLUMNS**2) / 20**2, 0))
    inside = ((ROWS - 9 * np.sin(turn)) ** 2 + (COLUMNS - 9 * np.cos(turn)) ** 2) / 3**2
    frames = uneven() - 0.4 * dome - 0.1 * np.sqrt(np.maximum(1 - inside, 0))
    hidden = speck(2, -10, size=2.4, depth=0.45)
    noisy = frames + hidden + NOISE * np.random.default_rng(4).standard_normal(frames.shape)
    found = fit_empty_field(noisy.astype(np.float32))
    assert found.specks == 1
    assert np.abs(deviation(found.log_light, uneven() + hidden)).max() < 0.25 * np.abs(hidden).max()


def rod(turns: np.ndarray) -> np.ndarray:
    """Attenuation of a thin rod about the optical axis at ``(K,)`` angles."""
    turn = turns[:, None, None]
    x1 = np.cos(turn) * COLUMNS + np.sin(turn) * ROWS
    x2 = np.cos(turn) * ROWS - np.sin(turn) * COLUMNS
    return np.asarray(0.4 * np.sqrt(np.maximum(1 - (x1 / 28) ** 2 - (x2 / 6) ** 2, 0)))


def with_rod(field: np.ndarray, turns: np.ndarray) -> EmptyField:
    noise = NOISE * np.random.default_rng(6).standard_normal((FRAMES, SIZE, SIZE))
    return fit_empty_field((field - rod(turns) + noise).astype(np.float32))


@pytest.mark.parametrize(
    ("place", "least"), [((-34, 20), 1.0), ((16, 10), 0.2)], ids=["never covered", "covered at times"]
)
def test_dust_as_large_as_a_part_of_the_particle_does_not_pass_for_it(
    place: tuple[int, int], least: float
) -> None:
    turns = np.deg2rad(50) * np.sin(np.linspace(0, 4 * np.pi, FRAMES))
    dust = speck(*place, size=2.4, depth=0.3)
    found = with_rod(uneven() + dust, turns)
    assert found.outside[place[0] + SIZE // 2, place[1] + SIZE // 2] >= least
    near = np.hypot(ROWS - place[0], COLUMNS - place[1]) < 12
    error = np.abs(deviation(found.log_light, uneven() + dust))[near]
    assert error.max() < 6 * NOISE / np.sqrt(FRAMES * least)


def test_a_part_of_the_particle_that_is_always_there_is_no_dust() -> None:
    turns = np.deg2rad(4) * np.sin(np.linspace(0, 4 * np.pi, FRAMES))
    dust = speck(-30, 20, size=2.0, depth=0.4)
    found = with_rod(uneven() + dust, turns)
    assert np.abs(deviation(found.log_light, uneven() + dust)).max() < 0.05
    assert found.outside[SIZE // 2, SIZE // 2] == 0


def test_specks_are_fitted_again_to_what_is_measured_beside_the_particle() -> None:
    """The mean of what covers a speck in part is no paraboloid; beside it the field is known."""
    noise = NOISE * np.random.default_rng(5).standard_normal((FRAMES, SIZE, SIZE))
    edge = np.clip(COLUMNS / 6, 0, 1) ** 2
    frames = (speck(4, 1, size=2.0) - 0.3 * edge + noise).astype(np.float32)
    measured = np.where(COLUMNS < 1, speck(4, 1, size=2.0), np.nan)
    known = [np.array([4.5 + SIZE // 2, 2.0 + SIZE // 2, 2.4, 0.5])]
    plain, told = (
        specks.fit_again(specks.Standing.of(frames, NOISE, image), known)[0] for image in (None, measured)
    )
    error = [
        np.abs(specks.render([one], (SIZE, SIZE)) - speck(4, 1, size=2.0)).max() for one in (plain, told)
    ]
    assert error[1] < 0.04
    assert error[0] > 2 * error[1]


def test_a_speck_that_two_fits_lead_to_is_told_once() -> None:
    noise = NOISE * np.random.default_rng(5).standard_normal((FRAMES, SIZE, SIZE))
    particle = 0.3 * np.clip(COLUMNS / 20, 0, 1)
    standing = specks.Standing.of((speck(4, -3, size=2.0) - particle + noise).astype(np.float32), NOISE)
    here = np.array([4 + SIZE // 2, -3 + SIZE // 2, 2.0, 0.4])
    beside = here + np.array([1.5, 0.0, 0.0, -0.39])
    again = specks.fit_again(standing, [beside, here])
    np.testing.assert_allclose(specks.render(again, (SIZE, SIZE)), speck(4, -3, size=2.0), atol=0.05)


def test_a_speck_at_the_rim_of_a_ball_that_always_is_there() -> None:
    """The rim of what is round hardly changes: how the mean looks there is not told by changes."""
    turn = np.linspace(0, 3 * np.pi, FRAMES)[:, None, None]
    outer, inner = (np.sqrt(np.maximum(r**2 - ROWS**2 - COLUMNS**2, 0)) / 20 for r in (20, 18))
    spot = (ROWS - 17 * np.sin(turn)) ** 2 + (COLUMNS - 17 * np.cos(turn)) ** 2
    ball = 0.3 * (outer - 0.7 * inner) + 0.12 * np.sqrt(np.maximum(1 - spot / 4**2, 0))
    dust = speck(18, -16, size=2.4, depth=0.15)
    noise = 0.02 * np.random.default_rng(8).standard_normal(ball.shape)
    found = fit_empty_field((uneven() + dust - ball + noise).astype(np.float32))
    near = np.hypot(ROWS - 18, COLUMNS + 16) < 8
    assert np.abs(deviation(found.log_light, uneven() + dust))[near].max() < 0.2 * np.abs(dust).max()


def test_what_drifts_with_the_particle_is_no_speck() -> None:
    carried = np.zeros((FRAMES, SIZE, SIZE), np.float32)
    for image, move in zip(carried, 3 * np.sin(np.arange(FRAMES) / 9), strict=True):
        square = (ROWS - move) ** 2 + COLUMNS**2
        image[:] = 0.3 * np.sqrt(np.maximum(1 - square / 30**2, 0)) + 0.3 * np.exp(-square / (2 * 3.5**2))
    frames = uneven() - carried + NOISE * np.random.default_rng(3).standard_normal(carried.shape)
    assert fit_empty_field(frames.astype(np.float32)).specks == 0


def following(share: float, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Return ``(P, K)`` frames of a spot that follows a share of the drift, and the spot if it followed all.

    To first order in the drift, which is what is compared.
    """
    move = 2 * np.sin(np.arange(FRAMES) / 3)[:, None, None]
    spot = (0.3 * np.exp(-((ROWS - move) ** 2 + COLUMNS**2) / (2 * 2.5**2))).reshape(FRAMES, -1).T
    here = spot[:, :1]  # the first frame's drift is none
    noisy = noise * np.random.default_rng(9).standard_normal(spot.shape)
    return here + share * (spot - here) + noisy, spot


@pytest.mark.parametrize(("share", "low", "high"), [(0.0, 10, 1e9), (0.5, -4, 4), (1.0, -1e9, -10)])
def test_how_far_a_spot_follows_the_drift_tells_whether_it_stays(
    share: float, low: float, high: float
) -> None:
    seen, spot = following(share, noise=0.02)
    assert low < specks._in_place(seen - spot[:, :1], spot - spot[:, :1]) < high


def test_what_may_be_the_particle_itself_must_stay_more_clearly() -> None:
    seen, spot = following(0.3, noise=0.2)
    assert 4 < specks._in_place(seen - spot[:, :1], spot - spot[:, :1]) < 7
    assert specks._stays(seen, spot[:, :1], spot, share=0.1)
    assert not specks._stays(seen, spot[:, :1], spot, share=0.9)
    still, spot = following(0.0, noise=0.02)
    assert specks._stays(still, spot[:, :1], spot, share=0.9)


def test_a_dark_speck_before_a_weak_particle() -> None:
    """Most of what absorbs is the speck; what drifts over it is the particle."""
    dust = speck(2, -3, size=2.5, depth=0.9)
    frames = np.zeros((FRAMES, SIZE, SIZE))
    turn, move = np.linspace(0, 3 * np.pi, FRAMES), 5 * np.sin(np.arange(FRAMES) / 6)
    for image, angle, down in zip(frames, turn, move, strict=True):
        x1 = np.cos(angle) * COLUMNS + np.sin(angle) * (ROWS - down)
        x2 = np.cos(angle) * (ROWS - down) - np.sin(angle) * COLUMNS
        image[:] = 0.025 * np.sqrt(np.maximum(1 - (x1 / 22) ** 2 - (x2 / 17) ** 2, 0))
    noise = NOISE * np.random.default_rng(7).standard_normal(frames.shape)
    found = fit_empty_field((uneven() + dust - frames + noise).astype(np.float32))
    assert np.abs(dust).sum() > specks._MOST * (np.abs(dust).sum() + frames.mean(axis=0).sum())
    assert np.abs(deviation(found.log_light, uneven() + dust)).max() < 0.05 * np.abs(dust).max()


def enlarged(image: np.ndarray, times: int) -> np.ndarray:
    """Return an image with `times` as many rows and columns, and one more of each."""
    return np.pad(np.kron(image, np.ones((times, times))), ((0, 1), (0, 1)), mode="edge")


def counted(logs: np.ndarray) -> Sample:
    """Return noisy camera counts of some frames."""
    light = np.random.default_rng(2).poisson(np.exp(logs - logs.max()) * 40_000)
    return Sample(Counts(0.0, 65535.0), light.astype(np.uint16))


@pytest.mark.slow
def test_large_frames_are_looked_at_coarsely_but_specks_in_them_finely() -> None:
    times, frames = 6, 24
    field = enlarged(uneven(), times)
    rows, columns = np.indices(field.shape) - len(field) // 2
    beneath = np.log(1 - 0.4 * np.exp(-((rows - 20) ** 2 + (columns + 30) ** 2) / (2 * 1.5**2)))
    beside = np.log(1 - 0.4 * np.exp(-((rows + 240) ** 2 + (columns + 240) ** 2) / (2 * 1.5**2)))
    attenuation = ellipse()[:: FRAMES // frames][:frames]
    sample = counted(np.array([field + beneath + beside - enlarged(image, times) for image in attenuation]))
    tracemalloc.start()
    found = fit_to_sample(sample)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10 * sample.images.nbytes
    assert found.light.cells.binning == 4
    assert found.specks == 1
    free = np.hypot(rows, columns) > 40 * times
    error = found.log_light - (field + beneath + beside)
    error -= error[free].mean()
    noise = 1 / np.sqrt(sample.images.mean())
    assert np.abs(error).max() < 3 * noise
    assert abs(error[~free].mean()) < 0.1 * noise


def test_median_of_large_frames() -> None:
    field = enlarged(uneven(), 6)
    flicker = 0.05 * np.sin(7 * np.arange(15))[:, None, None]
    logs = field + flicker + np.zeros((15, 1, 1))
    for n, image in enumerate(logs):
        image[25 * n : 25 * n + 100, 200:300] -= 1.0
    error = median_field(counted(logs)) - field
    assert error.std() < 0.6 / np.sqrt(20_000)
