from __future__ import annotations

import numpy as np
import pytest

from trapcli.motion.time_derivatives import choose_filters, difference_noise, fit_weights

STEP = 0.01


def waves(n: int, rates: tuple[float, ...] = (1.0, 4.0, 9.0)) -> np.ndarray:
    t = STEP * np.arange(n)
    return np.exp(1j * np.multiply.outer(t, rates))


def exact(n: int, order: int, rates: tuple[float, ...] = (1.0, 4.0, 9.0)) -> np.ndarray:
    return waves(n, rates) * (1j * np.array(rates)) ** order


def white(n: int, k: int, sigma: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return sigma / np.sqrt(2) * (rng.standard_normal((n, k)) + 1j * rng.standard_normal((n, k)))


@pytest.mark.parametrize("order", [0, 1, 2, 3])
@pytest.mark.parametrize("offsets", [np.arange(-4, 5), np.arange(0, 7), np.array([-5, -4, -1, 0, 2, 6, 7])])
def test_weights_differentiate_polynomials_exactly(order: int, offsets: np.ndarray) -> None:
    polynomial = np.polynomial.Polynomial([0.3, -1.2, 0.7, 0.2, -0.1])
    weights = fit_weights(offsets, 4, order)
    assert weights @ polynomial(offsets) == pytest.approx(
        polynomial.deriv(order)(0) if order else 0.3, rel=1e-9
    )


def test_clean_series_gets_short_windows_of_high_degree() -> None:
    filters = choose_filters(waves(400), (1, 2))
    for order, bar in ((1, 1e-10), (2, 1e-7)):
        found = filters[order - 1].apply(waves(400), STEP)
        assert np.abs(found - exact(400, order)).max() < bar
        assert filters[order - 1].windows[-1].degree >= 5
        assert filters[order - 1].windows[-1].width <= 31


@pytest.mark.parametrize("sigma", [1e-5, 1e-2])
@pytest.mark.parametrize("order", [0, 1, 2])
def test_noisy_series_are_off_by_the_predicted_error(sigma: float, order: int) -> None:
    n = 600
    (chosen,) = choose_filters(waves(n) + white(n, 3, sigma), (order,))
    error = np.abs(chosen.apply(waves(n) + white(n, 3, sigma), STEP) - exact(n, order))
    middle = np.sqrt(np.mean(error[150:-150] ** 2)) * STEP**order
    assert 0.5 < middle / chosen.error < 2.0
    # against the noise itself, and differences between neighbours
    assert middle < 0.4 * sigma * {0: 1.0, 1: 0.7, 2: 2.4}[order]


def test_windows_grow_with_the_noise() -> None:
    widths = [
        choose_filters(waves(600) + white(600, 3, sigma), (1,))[0].windows[-1].width
        for sigma in (1e-9, 1e-5, 1e-2)
    ]
    assert widths == sorted(widths)
    assert widths[0] < widths[-1]


def test_ends_are_worse_than_the_middle_but_not_wild() -> None:
    n, sigma = 600, 1e-3
    (rate,) = choose_filters(waves(n) + white(n, 3, sigma), (1,))
    gains = rate.gains(n)
    assert gains[0] > gains[n // 2]
    assert gains == pytest.approx(gains[::-1])
    error = np.abs(rate.apply(waves(n) + white(n, 3, sigma, seed=4), STEP) - exact(n, 1)) * STEP
    # a few standard deviations, bias included
    assert error[[0, -1]].max() < 6 * sigma * gains[0]


def test_noise_is_read_off_differences() -> None:
    n = 500
    for sigma in (1e-6, 1e-3):
        assert difference_noise(waves(n) + white(n, 3, sigma)) == pytest.approx(sigma, rel=0.1)
    assert difference_noise(waves(n)) < 1e-15


def test_gain_of_coloured_noise() -> None:
    n = 4000
    kernel = np.array([1.0, 2.0, 1.0])
    rng = np.random.default_rng(3)
    noise = np.convolve(rng.standard_normal(n + 2), kernel / np.linalg.norm(kernel), mode="valid")[:, None]
    (rate,) = choose_filters(noise, (1,), noise=1.0, correlation=kernel, width=21)
    found = rate.apply(noise, 1.0)[50:-50].std()
    assert found == pytest.approx(rate.gains(n, kernel)[n // 2], rel=0.1)


def test_missing_frames_are_bridged_and_long_gaps_are_not() -> None:
    series = waves(300)
    series[[40, 41, 77]] = np.nan
    series[150:200] = np.nan
    (rate,) = choose_filters(series, (1,))
    found = rate.apply(series, STEP)
    # as exact as the shorter side of a gap allows
    near = [38, 39, 42, 43, 76, 78]
    assert np.abs(found[near] - exact(300, 1)[near]).max() < 1e-5
    assert np.isnan(found[[40, 41, 77, 150, 175, 199]]).all()
    assert np.isfinite(found[:35]).all()


def test_a_fixed_width_is_kept() -> None:
    (rate,) = choose_filters(waves(100), (1,), width=20)
    assert {window.width for window in rate.windows} == {21}


@pytest.mark.parametrize("n", [5, 6, 9])
def test_few_frames_do(n: int) -> None:
    filters = choose_filters(waves(n), (0, 1, 2))
    assert np.abs(filters[1].apply(waves(n), STEP) - exact(n, 1)).max() < 0.05
    assert np.isfinite(filters[2].apply(waves(n), STEP)).all()


def test_part_of_the_frames_is_the_same_as_all() -> None:
    series = waves(200) + white(200, 3, 1e-4)
    (rate,) = choose_filters(series, (1,))
    part, whole = rate.apply(series, STEP, frames=range(60, 130)), rate.apply(series, STEP)
    assert np.allclose(part, whole[60:130], rtol=1e-10)
