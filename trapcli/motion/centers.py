"""Centres C₂ of the frames (``eq:c2``), exact on clean frames and weighted around the object on noisy ones.

One rule serves both: the centroid is taken inside a smooth disc about itself, as wide as the object stands
out of the noise. Without noise that is the whole frame and the plain centroid; with noise the disc keeps
out what is not object.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dctn, rfft2
from scipy.ndimage import uniform_filter
from scipy.special import gammaincinv

from trapcli.motion.cells import Cells
from trapcli.motion.time_derivatives import choose_filters
from trapcli.stack.frames import Frames

Array = NDArray[np.float64]
Progress = Callable[[str, int, int], None]

TAPER = 1.2
"""Radius at which the weight has fallen to 0, in radii of the object."""

_SURVEY = 32  # frames that the noise and the radius are measured on
_FEWEST = 8
_SURVEY_BYTES = 128 << 20  # that they may take
_RING = 2.0  # width of the rings of the radial profile [pixels]
_VISIBLE = 0.06  # least power of a ring that counts as object, in units of the noise's
_PLATEAU = 0.2  # power of the empty field beyond the noise's, in its units, that may be a misjudged noise
_GAP = 4, 0.25  # rings without anything, in all and as a share of those within, beyond which there may be
_BESIDE = 0.01  # something else, if it holds no more than this share of the power
_COARSE = 256  # pixels across on which the radius is measured
_SIGNIFICANT = 5.0  # standard deviations
_BLANK = 0.02  # share of the median mass below which a frame holds no object
_CLIPPED = 0.01  # mean attenuation on one side of the frame, as a share of the frame's highest
_SPARSE = 4  # of so many rows and columns one tells what the empty field is like roughly
_ROUGH = 0.02  # error of the centre, in radii of the object, at which that level is measured
_OUTSIDE = 0.1  # share of the frame outside the object's disc that tells the level of the empty field
_CONVERGED = 1e-9  # step that ends the iteration [pixels]
_FINE = 0.01  # or in units of the error that the noise makes
_MOST_STEPS = 50
_FAINT = 0.8  # share of the highest modes, the faintest, that tells the noise
_BLOCK = 16  # edge of the blocks in which a codec's loss is looked for [pixels]
_FEWEST_BLOCKS = 4  # along an edge of the frame
_EVEN = (0.2, 0.35), (0.35, 0.5)  # bands that a codec leaves as they are, in units of the highest frequency
_ALIKE = 1.3  # ratio of the noise's power in the two
_CUT = 1.5  # power in them, in units of that in the corners, that shows a codec at work
_CHI_SQUARE_MEDIAN = 0.4549, 1.061  # of one degree of freedom, and √M times its error in M samples
_SHAKEN = 3.0  # standard deviations by which centres must scatter more than their noise
_EXACT = 1e-3  # share of its noise that a frame's centre keeps at least away from a smooth curve
_RIM = 16  # part of the shorter edge that a frame's rim is wide
_LEAST_RIM = 8  # its width at least [pixels]
_INDEPENDENT = 0.85  # noise of the change at the rim, in units of that of independent frames


@dataclass(frozen=True)
class Centers:
    """Centres of N frames and what was learned on the way.

    Attributes
    ----------
    center, errors:
        ``(N, 2)`` C₂ as (x1, x2) from pixel ``(H//2, W//2)`` and its 1-σ error from pixel noise [length]; NaN
        in blank frames. Smoothed in time where the noise, not the motion, makes it rough.
    mass:
        ``(N,)`` integral of the attenuation over the object's disc; 0 in blank frames.
    level:
        ``(N,)`` mean attenuation of the empty field around the object, to be subtracted.
    noise:
        Standard deviation of the noise of one pixel [attenuation].
    radius:
        Distance from the centre up to which attenuation stands out of the noise [length].
    clipped:
        ``(N,)`` frames whose object touches the edge of the field of view.
    """

    center: Array
    errors: Array
    mass: Array
    level: Array
    noise: float
    radius: float
    clipped: NDArray[np.bool_]


def estimate_centers(
    attenuation: Frames, *, pixel_size: float = 1.0, progress: Progress | None = None
) -> Centers:
    """Find the centre of every frame (``eq:c2``; Elbau et al. 2020, Inverse Problems 36).

    Parameters
    ----------
    attenuation:
        N attenuation projections.
    pixel_size:
        Edge of a pixel [length].
    progress:
        Called as ``progress("centers", done, N)``.
    """
    survey = sample_frames(attenuation)
    noise = pixel_noise(survey)
    radius = object_radius(survey, noise)
    tracker = Tracker(len(attenuation), noise, radius)
    for block in attenuation.blocks():
        for image in block:
            tracker.follow(image)
        if progress is not None:
            progress("centers", tracker.done, len(attenuation))
    return tracker.centers(attenuation.shape[1:], pixel_size)


class Tracker:
    """Finds the object in one frame after the other.

    Parameters
    ----------
    count:
        Number of frames N.
    noise, radius:
        Standard deviation of the noise of one pixel, and radius of the object [pixels], of the frames that
        `follow` gets.
    """

    def __init__(self, count: int, noise: float, radius: float) -> None:
        self.done = 0
        self.place = np.full((count, 2), np.nan)
        self.level = np.zeros(count)
        self._mass, self._clipped = np.zeros(count), np.zeros(count, bool)
        self._noise, self._radius = noise, radius
        self._previous: _Found | None = None

    def follow(self, image: NDArray[Any]) -> bool:
        """Find the object in the next frame, ``(H, W)``; tell whether it is there."""
        n = self.done
        self.done += 1
        found = _find(image, self._noise, self._radius, self._previous)
        if found is None:
            return False
        self._previous = found
        self.place[n], self._mass[n], self.level[n] = found.center, found.mass, found.level
        self._clipped[n] = _touches_edge(image, self._noise, found.level)
        return True

    def centers(self, shape: tuple[int, ...], pixel_size: float, cells: Cells | None = None) -> Centers:
        """Return what was found in all frames of ``(H, W)`` `shape`, smoothed in time.

        Parameters
        ----------
        cells:
            What the frames were averaged to; None: not at all.
        """
        cells = cells or Cells(shape)
        place, mass = cells.to_pixels(self.place), self._mass * cells.binning**2
        if (mass > 0).any():
            faint = mass < _BLANK * np.median(mass[mass > 0])
            place[faint], mass[faint] = np.nan, 0.0
        noise, radius = self._noise * cells.binning, self._radius * cells.binning
        center, errors = _smooth(place, mass, noise * _lever(shape, radius))
        return Centers(
            center=center * pixel_size,
            errors=errors * pixel_size,
            mass=mass * pixel_size**2,
            level=self.level,
            noise=noise,
            radius=radius * pixel_size,
            clipped=self._clipped,
        )


def sample_frames(frames: Frames, count: int = _SURVEY) -> NDArray[Any]:
    """Return at most `count` frames without NaN, spread evenly over the stack, ``(K, H, W)``.

    Of large frames, fewer.
    """
    frame_bytes = frames.shape[1] * frames.shape[2] * frames.dtype.itemsize
    count = min(count, max(_FEWEST, _SURVEY_BYTES // frame_bytes))
    images = [
        np.array(image) for image in frames.pick(spread(len(frames), count)) if np.isfinite(image).all()
    ]
    return np.array(images).reshape(-1, *frames.shape[1:])


def spread(n: int, count: int) -> NDArray[np.int_]:
    """Return at most `count` positions spread evenly over 0 … n − 1."""
    return np.unique(np.linspace(0, n - 1, min(count, n)).round().astype(int))


def pixel_noise(images: NDArray[Any]) -> float:
    """Return the standard deviation of white noise in ``(K, H, W)`` images.

    It is read off the corners of their Fourier transforms, beyond the circle that a smooth object keeps
    inside; of a lossy video, whose codec has emptied the corners, off what it has left as it was.
    """
    if not len(images) or min(images.shape[1:]) < 4:
        return 0.0
    # what the rim of a frame holds of a background stays out of the corners
    return max(_corner_noise(images, np.hanning), _uncut_noise(images))


def noise_between(image: NDArray[Any], following: NDArray[Any]) -> float:
    """Return the standard deviation of white noise in an ``(H, W)`` image, told by the next one.

    Sharp edges reach the corners of the Fourier transform. They hardly move from one frame to the next, so
    what changes is the noise, unless that itself is repeated or interpolated in time: then each image is
    judged alone.
    """
    # differences of unsigned counts would wrap around
    image, following = (np.asarray(i, np.result_type(i, np.float32)) for i in (image, following))
    if min(image.shape) < 2 * _LEAST_RIM or not np.isfinite(following).all():
        return pixel_noise(image[None])
    change = (following - image) / np.sqrt(2).astype(image.dtype)
    if not _rim_noise(change) > _INDEPENDENT * _rim_noise(image):
        return pixel_noise(image[None])
    return max(_corner_noise(change[None], _taper), _uncut_noise(image[None]))


def _rim_noise(image: NDArray[Any]) -> float:
    """Return the median of what is left at the rim of anything smooth."""
    width = max(_LEAST_RIM, min(image.shape) // _RIM)
    sides = image[:width], image[-width:], image[:, :width], image[:, -width:]
    sharp = [np.abs(np.diff(np.diff(side, 2, axis=0), 2, axis=1)).ravel() for side in sides]
    return float(np.median(np.concatenate(sharp)))


def _corner_noise(images: NDArray[Any], taper: Callable[[int], Array]) -> float:
    k2 = np.abs(np.fft.fftfreq(images.shape[1], 0.5))[:, None]
    k1 = np.abs(np.fft.rfftfreq(images.shape[2], 0.5))
    corner = np.minimum(k1, k2) > 0.7
    window = taper(images.shape[1])[:, None] * taper(images.shape[2])
    powers = [_faint_mean(np.abs(rfft2(image * window)[corner]) ** 2) / np.sum(window**2) for image in images]
    return float(np.sqrt(np.median(powers)))


def _taper(size: int) -> Array:
    """Return a window that rises over a quarter of its `size` at each end, as a cosine does (Tukey)."""
    place = np.arange(size) + 0.5
    return np.asarray(np.sin(np.pi / 2 * np.minimum(1.0, 4 / size * np.minimum(place, size - place))) ** 2)


def _faint_mean(power: Array) -> float:
    """Return the mean power of noise, told by the faintest modes: what is bright may be something else."""
    faintest = np.sort(power)[: int(np.ceil(_FAINT * len(power)))]
    # this is what the faintest share of exponentially distributed powers holds of their sum
    held = _FAINT + (1 - _FAINT) * np.log1p(-_FAINT)
    return float(faintest.sum() / len(power) / held)


def _uncut_noise(images: NDArray[Any]) -> float:
    """Return the noise below the frequencies from which on a lossy codec has cut it; 0 where none has.

    Such noise is as strong up to half of the highest frequency, and falls from there on. This is looked for
    in the quietest blocks of each image, which the empty field fills.
    """
    height, width = (size // _BLOCK * _BLOCK for size in images.shape[1:])
    if min(height, width) < _FEWEST_BLOCKS * _BLOCK:
        return 0.0
    v, u = np.meshgrid(*2 * [np.arange(_BLOCK) / _BLOCK])
    radial = np.hypot(u, v)
    bands = [(radial > low) & (radial <= high) for low, high in _EVEN] + [np.minimum(u, v) > 0.7]
    powers = []
    for image in images:
        blocks = image[:height, :width].reshape(height // _BLOCK, _BLOCK, width // _BLOCK, _BLOCK)
        power = dctn(blocks.astype(float), axes=(1, 3), norm="ortho").transpose(0, 2, 1, 3) ** 2
        means = [power[..., band].mean(axis=-1) for band in bands]
        # among blocks of white noise, a quarter of the means of m modes lies below this share of its power:
        # the first quartile of χ², without the long import of its distribution
        below = [2 * gammaincinv(m / 2, 0.25) / m for m in map(np.count_nonzero, bands)]
        low, middle, corner = (np.quantile(m, 0.25) / share for m, share in zip(means, below, strict=True))
        cut = max(low, middle) < _ALIKE * min(low, middle) and middle > _CUT * corner
        powers.append(np.median(means[1]) if cut else 0.0)
    return float(np.sqrt(np.median(powers)))


def object_radius(images: NDArray[Any], noise: float) -> float:
    """Return the distance from the centre up to which the object stands out of the noise [pixels].

    Parameters
    ----------
    images:
        ``(K, H, W)`` attenuation.
    noise:
        Standard deviation of the noise of one pixel.
    """
    # a coarse look will do: pixels are averaged down to some 256 across
    b = max(1, int(min(images.shape[1:])) // _COARSE)
    if b > 1:
        cells = Cells(images.shape[1:], b)
        return b * object_radius(np.array([cells.average(image) for image in images]), noise / b)
    radius = farthest = float(np.hypot(*images.shape[1:]))
    found: list[_Found | None] = [None] * len(images)
    for _ in range(3):
        pixels, power = np.zeros((2, int(np.hypot(*images.shape[1:]) / _RING) + 1))
        for n, image in enumerate(images):
            # the border stands in for the empty field until the radius is known
            image = image - np.median(np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]]))
            found[n] = _find(image, noise, radius, found[n])
            _add_profile(pixels, power, image, found[n])
        pixels, power = pixels[pixels > 0], power[pixels > 0]
        if not len(pixels):
            return farthest
        least = np.maximum(_VISIBLE, _SIGNIFICANT * np.sqrt(2 / pixels)) * noise**2
        # a noise that is a few percent off must not pass for an object as wide as the frame
        least += np.clip(np.median(power / pixels), 0, _PLATEAU * noise**2)
        seen = np.flatnonzero(power > least * pixels)
        if not len(seen):
            return farthest
        radius = min(_RING * (_outermost(seen, power) + 1.0), farthest)
    return radius


def _outermost(seen: NDArray[np.intp], power: Array) -> int:
    """Return the last ring of the object among those `seen`: what is left of a background lies apart."""
    whole = float(power[seen].sum())
    for ring, following in pairwise(seen):
        apart = following - ring > max(_GAP[0], _GAP[1] * ring)
        if apart and power[seen[seen > ring]].sum() < _BESIDE * whole:
            return int(ring)
    return int(seen[-1])


def disc(shape: tuple[int, ...], center: Array, radius: float) -> tuple[Array, slice, slice]:
    """Return a smooth disc, 1 inside `radius` and 0 beyond `TAPER` radii, and the rows and columns it covers.

    Parameters
    ----------
    shape:
        ``(H, W)`` of the frame.
    center, radius:
        In pixels, from pixel ``(H//2, W//2)``.
    """
    x1, x2 = _axes(shape)
    reach = TAPER * radius
    rows = _inside(np.abs(x2 - center[1]) <= reach)
    columns = _inside(np.abs(x1 - center[0]) <= reach)
    width = reach**2 - radius**2
    ramp = (reach**2 - (x2[rows, None] - center[1]) ** 2) / width - (x1[columns] - center[0]) ** 2 / width
    np.clip(ramp, 0.0, 1.0, out=ramp)
    weights = ramp * ramp
    ramp *= -2
    ramp += 3
    weights *= ramp
    return weights, rows, columns


@dataclass(frozen=True)
class _Found:
    """Centre [pixels], mass and level of one frame."""

    center: Array
    mass: float
    level: float


def _find(image: NDArray[Any], noise: float, radius: float, previous: _Found | None) -> _Found | None:
    """Look for the object where it was in the previous frame; None where nothing stands out of the noise."""
    if not np.isfinite(image).all():
        return None
    outside = _outside_share(image.shape, radius) > _OUTSIDE
    if previous is None:
        border = float(np.median(np.concatenate([image[:2].ravel(), image[-2:].ravel()])))
        level = border if outside else 0.0
        center = _brightest(image - border)
    else:
        level, center = previous.level, previous.center
    found = _centroid(image, level, noise, radius, center, _ROUGH * radius if outside else 0.0)
    if found is not None and outside:
        level = _level(image, noise, radius, found[0])
        found = _centroid(image, level, noise, radius, found[0])
    if found is None:
        return None if previous is None else _find(image, noise, radius, None)
    return _Found(*found, level)


def _centroid(
    image: NDArray[Any], level: float, noise: float, radius: float, center: Array, enough: float = 0.0
) -> tuple[Array, float] | None:
    """Iterate the weighted centroid from a start; None where the mass does not stand out of the noise."""
    x1, x2 = _axes(image.shape)
    mass, lever = 0.0, _lever(image.shape, radius)
    for _ in range(_MOST_STEPS):
        weights, rows, columns = disc(image.shape, center, radius)
        weighted = np.subtract(image[rows, columns], level, dtype=float)
        weighted *= weights
        along, across = weighted.sum(axis=0), weighted.sum(axis=1)
        mass = float(across.sum())
        if not mass > _SIGNIFICANT * noise * np.linalg.norm(weights):
            return None
        old = center
        center = np.array([along @ x1[columns], across @ x2[rows]]) / mass
        if np.abs(center - old).max() < max(_CONVERGED, _FINE * noise * lever / mass, enough):
            break
    return center, mass


def _add_profile(pixels: Array, power: Array, image: NDArray[Any], found: _Found | None) -> None:
    """Add the pixels, and the object's power, in rings about the centre."""
    if found is None:
        return
    x1, x2 = _axes(image.shape)
    r2 = (x1 - found.center[0]) ** 2 + ((x2 - found.center[1]) ** 2)[:, None]
    ring = np.minimum(np.sqrt(r2) / _RING, len(pixels) - 1).astype(int).ravel()
    pixels += np.bincount(ring, minlength=len(pixels))
    # products of neighbours: white noise averages out, however strong it is in this part of the frame
    cleared = image - found.level
    product = cleared * (np.roll(cleared, 1, axis=0) + np.roll(cleared, 1, axis=1)) / 2
    power += np.bincount(ring, product.ravel(), len(pixels))


def _level(image: NDArray[Any], noise: float, radius: float, center: Array) -> float:
    """Return the mean of the empty field, of what is like most of it: another particle does not count."""
    stride = max(1, min(image.shape) // _COARSE)
    x1, x2 = (x[::stride] for x in _axes(image.shape))
    seen = image[::stride, ::stride].astype(float)
    outside = (x2[:, None] - center[1]) ** 2 > (TAPER * radius) ** 2 - (x1 - center[0]) ** 2
    some = seen[::_SPARSE, ::_SPARSE][outside[::_SPARSE, ::_SPARSE]]
    if not len(some):
        return 0.0
    typical = np.abs(seen - np.median(some)) <= _SIGNIFICANT * noise
    typical &= outside
    count = np.count_nonzero(typical)
    return float(np.vdot(seen, typical.astype(float))) / count if count else float(np.median(some))


@lru_cache(maxsize=64)
def _outside_share(shape: tuple[int, ...], radius: float) -> float:
    """Return the share of the frame that a disc about its middle leaves outside."""
    x1, x2 = _axes(shape)
    outside: NDArray[np.bool_] = x1**2 + (x2**2)[:, None] > (TAPER * radius) ** 2
    return float(outside.mean())


def _smooth(center: Array, mass: Array, moment_noise: float) -> tuple[Array, Array]:
    """Smooth the centres in time as far as their known noise allows; return them and their errors."""
    errors = np.full(center.shape, np.nan)
    seen = mass > 0
    if seen.any():
        noise = moment_noise / float(np.median(mass[seen]))
        (smoother,) = choose_filters(center, (0,), noise=noise)
        smooth = smoother.apply(center, 1.0)
        judged = np.isfinite(smooth).all(axis=1) & seen
        errors[seen] = noise
        # of a projection, the noise that is left is its weight of the frame itself
        gain = smoother.gains(len(center))[judged, None] ** 2
        rest = center[judged] - smooth[judged]
        shaken = _shaken(rest / np.sqrt(np.maximum(1 - gain, _EXACT)), noise)
        errors[judged] = noise * np.sqrt(shaken + (1 - shaken) * gain)
        center[judged] = smooth[judged] + shaken * rest
    return center, errors


def _shaken(rest: Array, noise: float) -> float:
    """Return which share of ``(M, 2)`` independent rests of the smoothed centres is motion, not noise.

    A particle in a trap is shaken from frame to frame (Berg-Sørensen and Flyvbjerg 2004,
    DOI 10.1063/1.1645654): no smooth curve shows that.
    """
    if not rest.size:
        return 0.0
    median, error = _CHI_SQUARE_MEDIAN
    typical = float(np.median(rest**2)) / median
    least = noise**2 * (1 + _SHAKEN * error / median / np.sqrt(rest.size))
    return 1 - noise**2 / typical if typical > least else 0.0


def _inside(mask: NDArray[np.bool_]) -> slice:
    found = np.flatnonzero(mask)
    return slice(found[0], found[-1] + 1) if len(found) else slice(0, 0)


def _axes(shape: tuple[int, ...]) -> tuple[Array, Array]:
    """Return the coordinates of columns and rows in pixels from pixel ``(H//2, W//2)``."""
    x1, x2 = (np.arange(size, dtype=np.float64) - size // 2 for size in reversed(shape))
    return x1, x2


def _brightest(image: NDArray[Any]) -> Array:
    """Return roughly where the object is: the middle of what is bright after strong smoothing."""
    size = max(3, min(image.shape) // 16)
    smooth = uniform_filter(image, size)
    x1, x2 = _axes(image.shape)
    bright = smooth > 0.5 * smooth.max()
    moments: Array = np.array([bright.sum(axis=0) @ x1, bright.sum(axis=1) @ x2])
    return moments / max(float(bright.sum()), 1.0)


@lru_cache(maxsize=64)
def _lever(shape: tuple[int, ...], radius: float) -> float:
    """Return the error of the first moment for unit pixel noise: the root of the sum of squared distances."""
    weights, _, columns = disc(shape, np.zeros(2), radius)
    x1 = _axes(shape)[0][columns]
    return float(np.sqrt(np.sum((weights * x1) ** 2)))


def _touches_edge(image: NDArray[Any], noise: float, level: float) -> bool:
    """Tell whether attenuation on the frame's border stands out of the noise and is not a mere tail."""
    limit = max(_CLIPPED * (float(image.max()) - level), 2 * _SIGNIFICANT * noise / np.sqrt(max(image.shape)))
    return any(
        float(side.mean()) - level > limit for side in (image[0], image[-1], image[:, 0], image[:, -1])
    )
