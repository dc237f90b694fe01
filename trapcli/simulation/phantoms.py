"""Test objects whose projections are known in closed form, at any orientation.

All follow ``eq:affine`` and ``eq:J`` of Elbau et al. 2020, Inverse Problems 36: an object point y is seen at
the lab point x with y = C₃ + R (x − C₃ + T), that is x = Rᵀ(y − C₃) + C₃ − T. A quadratic form A of the
object becomes M = RᵀAR in the lab, and integrals along x₃ follow by completing the square in x₃.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

NEGLIGIBLE = 1e-6
"""Share of the highest density below which smooth objects count as ended (`Phantom.radius`)."""

# exp(-50) is 2e-22, which even times the paper's polynomial is below the rounding of the image
_GAUSSIAN_END = 50.0


class Phantom(ABC):
    """An object u with its exact centre and closed-form projections."""

    @property
    @abstractmethod
    def center(self) -> Array:
        """``(3,)`` centre C₃ of the object (``eq:center``) [length]."""

    @property
    @abstractmethod
    def mass(self) -> float:
        """∫ u dx; also the integral of every projection (``eqRecTotalAtt``)."""

    @property
    @abstractmethod
    def radius(self) -> float:
        """Radius about `center` outside of which u is below `NEGLIGIBLE` of its maximum [length]."""

    @abstractmethod
    def density(self, points: Array) -> Array:
        """Return u at ``(..., 3)`` object points as ``(...)``."""

    @abstractmethod
    def project(self, R: Array, T: Array, x1: Array, x2: Array) -> Array:
        """Return the attenuation projection (``eq:J``) on a grid.

        Parameters
        ----------
        R:
            ``(3, 3)`` rotation, lab to object.
        T:
            ``(3,)`` translation [length].
        x1, x2:
            ``(W,)`` and ``(H,)`` evenly spaced coordinates of the columns and rows [length].

        Returns
        -------
        Array
            ``(H, W)`` image J(x1, x2) = ∫ u(C₃ + R (x − C₃ + T)) dx₃.
        """

    def _lab(self, points: Array, R: Array, T: Array) -> Array:
        """Lab positions of ``(n, 3)`` object points."""
        lab: Array = (points - self.center) @ R + self.center - T
        return lab


class PaperPhantom(Phantom):
    """The paper's attenuation coefficient u(x) = Π |x − P_i|² exp(−|Dx|²/4) (``eq:defnumericsattcoeff``).

    In the lab the factors are |x − X_i|² with X_i the lab positions of P_i. Along a ray u is a polynomial of
    degree 6 times a Gaussian, so Gauss–Hermite quadrature with four nodes is exact. Every node adds a
    polynomial of degree 6 in (x1, x2): the image is one such polynomial times one two-dimensional Gaussian.
    """

    points: Array = np.array([[1.0, 0.5, -1.0], [-0.5, 1.0, 1.0], [0.0, -1.0, 0.5]])
    diagonal: Array = np.array([np.sqrt(2.0), 1.0, 1.0])

    @cached_property
    def _moments(self) -> tuple[float, Array]:
        # Gauss–Hermite in three dimensions: degree 7 in each variable, exact for x u(x)
        nodes, weights = np.polynomial.hermite.hermgauss(4)
        grid = np.stack(np.meshgrid(nodes, nodes, nodes, indexing="ij"), axis=-1).reshape(-1, 3)
        weight = np.einsum("i,j,k->ijk", weights, weights, weights).ravel()
        x = grid * 2.0 / self.diagonal
        values = weight * self._polynomial(x) * np.prod(2.0 / self.diagonal)
        return float(values.sum()), values @ x / values.sum()

    @property
    def center(self) -> Array:
        """Centre C₃."""
        return self._moments[1]

    @property
    def mass(self) -> float:
        """∫ u dx."""
        return self._moments[0]

    @cached_property
    def radius(self) -> float:
        """Radius of the support."""
        r = np.linspace(0.0, 20.0, 401)
        directions = Rotation.random(500, rng=np.random.default_rng(0)).as_matrix()[:, 2]
        values = self.density(self.center + r[:, None, None] * directions).max(axis=1)
        return float(r[np.flatnonzero(values > NEGLIGIBLE * values.max())[-1] + 1])

    def _polynomial(self, points: Array) -> Array:
        squares = np.sum((points[..., None, :] - self.points) ** 2, axis=-1)
        product: Array = np.prod(squares, axis=-1)
        return product

    def density(self, points: Array) -> Array:
        """Return u at ``(..., 3)`` points."""
        gauss: Array = np.exp(-0.25 * np.sum((points * self.diagonal) ** 2, axis=-1))
        return self._polynomial(points) * gauss

    def project(self, R: Array, T: Array, x1: Array, x2: Array) -> Array:
        """Return the ``(H, W)`` projection (``eq:J``)."""
        origin, *points = self._lab(np.vstack([np.zeros(3), self.points]), R, T)
        form, slope, along = _complete_square(R.T @ np.diag(self.diagonal**2) @ R)
        nodes, weights = np.polynomial.hermite.hermgauss(4)
        width = 2.0 / np.sqrt(along)
        coefficients = _product_coefficients(np.array(points) - origin, slope, width * nodes)
        polynomial = width * np.einsum("n,nij->ij", weights, coefficients)
        return _gaussian_image(polynomial, 0.25 * form, x1 - origin[0], x2 - origin[1])


def _complete_square(M: Array) -> tuple[Array, Array, float]:
    """Write xᵀMx = zᵀFz + M₃₃ (x₃ + ⟨l, z⟩)², z = (x1, x2); return F (2, 2), l (2,) and M₃₃."""
    along = float(M[2, 2])
    slope = M[:2, 2] / along
    return M[:2, :2] - along * np.outer(slope, slope), slope, along


def _product_coefficients(points: Array, slope: Array, nodes: Array) -> Array:
    """Coefficients [node, power of x1, power of x2] of Π |x − X_i|² at x₃ = node − ⟨slope, (x1, x2)⟩."""
    product = np.ones((len(nodes), 1, 1))
    l1, l2 = slope
    for x1, x2, x3 in points:
        d = nodes - x3
        factor = np.zeros((len(nodes), 3, 3))
        factor[:, 0, 0] = x1**2 + x2**2 + d**2
        factor[:, 1, 0] = -2 * (x1 + d * l1)
        factor[:, 0, 1] = -2 * (x2 + d * l2)
        factor[:, 2, 0] = 1 + l1**2
        factor[:, 0, 2] = 1 + l2**2
        factor[:, 1, 1] = 2 * l1 * l2
        size = product.shape[1]
        grown = np.zeros((len(nodes), size + 2, size + 2))
        for i in range(3):
            for j in range(3 - i):
                grown[:, i : i + size, j : j + size] += factor[:, i : i + 1, j : j + 1] * product
        product = grown
    return product


def _gaussian_image(polynomial: Array, form: Array, x1: Array, x2: Array) -> Array:
    """Σ p_ij x1^i x2^j exp(−zᵀ form z) on the grid, zero where the Gaussian is below double precision."""
    image = np.zeros((len(x2), len(x1)))
    # the box around zᵀFz ≤ c has the half widths sqrt(c (F⁻¹)_ii)
    half = np.sqrt(_GAUSSIAN_END * np.diag(np.linalg.inv(form)))
    columns, rows = _window(x1, half[0]), _window(x2, half[1])
    a, b = x1[columns], x2[rows]
    exponent = (-form[0, 0] * a**2) + (-form[1, 1] * b**2)[:, None]
    exponent -= (2 * form[0, 1] * b)[:, None] * a
    np.exp(exponent, out=exponent)
    degree = len(polynomial)
    exponent *= np.vander(b, degree, increasing=True) @ polynomial.T @ np.vander(a, degree, increasing=True).T
    image[rows, columns] = exponent
    return image


def _window(x: Array, half: float) -> slice:
    """Part of the ascending coordinates `x` with |x| ≤ half."""
    return slice(int(np.searchsorted(x, -half)), int(np.searchsorted(x, half, side="right")))


@dataclass(frozen=True, eq=False)
class Blobs(Phantom):
    """A sum of Gaussians, u(x) = Σ a_b exp(−½ (x − c_b)ᵀ S_b⁻¹ (x − c_b)).

    Attributes
    ----------
    amplitude:
        ``(B,)`` densities a_b.
    position:
        ``(B, 3)`` centres c_b [length].
    covariance:
        ``(B, 3, 3)`` covariances S_b [length²].
    """

    amplitude: Array
    position: Array
    covariance: Array

    @classmethod
    def random(
        cls, rng: np.random.Generator, *, count: int = 12, radius: float = 5.0, anisotropic: bool = True
    ) -> Blobs:
        """Return blobs of different sizes without symmetry, centred at 0 and filling the support radius."""
        position = _in_ball(rng, count)
        sigma = rng.uniform(0.12, 0.3, count)
        stretch = rng.uniform(0.6, 1.0, (count, 3)) if anisotropic else np.ones((count, 3))
        axes = Rotation.random(count, rng=rng).as_matrix()
        covariance = np.einsum("bij,bj,bkj->bik", axes, (sigma[:, None] * stretch) ** 2, axes)
        return cls(rng.uniform(0.4, 1.0, count), position, covariance)._fitted(radius)

    @classmethod
    def coaxial(
        cls,
        rng: np.random.Generator,
        *,
        count: int = 6,
        radius: float = 5.0,
        axis: tuple[float, float, float] = (0.0, 0.0, 1.0),
    ) -> Blobs:
        """Return round blobs on one line: a body of revolution, whose turn about `axis` can't be seen."""
        direction = np.array(axis) / np.linalg.norm(axis)
        position = np.linspace(-1.0, 1.0, count)[:, None] * direction
        sigma = rng.uniform(0.15, 0.4, count)
        covariance = sigma[:, None, None] ** 2 * np.eye(3)
        return cls(rng.uniform(0.4, 1.0, count), position, covariance)._fitted(radius)

    def _fitted(self, radius: float) -> Blobs:
        scale = radius / self.radius
        return Blobs(self.amplitude, (self.position - self.center) * scale, self.covariance * scale**2)

    @cached_property
    def _masses(self) -> Array:
        masses: Array = self.amplitude * np.sqrt((2 * np.pi) ** 3 * np.linalg.det(self.covariance))
        return masses

    @cached_property
    def center(self) -> Array:
        """Centre C₃."""
        center: Array = self._masses @ self.position / self._masses.sum()
        return center

    @property
    def mass(self) -> float:
        """∫ u dx."""
        return float(self._masses.sum())

    @cached_property
    def radius(self) -> float:
        """Radius of the support."""
        widest = np.sqrt(np.linalg.eigvalsh(self.covariance)[:, -1])
        reach = np.sqrt(-2 * np.log(NEGLIGIBLE)) * widest
        return float(np.max(np.linalg.norm(self.position - self.center, axis=1) + reach))

    def density(self, points: Array) -> Array:
        """Return u at ``(..., 3)`` points."""
        d = points[..., None, :] - self.position
        exponent = -0.5 * np.einsum("...bi,bij,...bj->...b", d, np.linalg.inv(self.covariance), d)
        values: Array = np.exp(exponent) @ self.amplitude
        return values

    def project(self, R: Array, T: Array, x1: Array, x2: Array) -> Array:
        """Return the ``(H, W)`` projection (``eq:J``)."""
        image = np.zeros((len(x2), len(x1)))
        position = self._lab(self.position, R, T)
        # the marginal of a Gaussian along x3 keeps its covariance in (x1, x2)
        planar = (R.T @ self.covariance @ R)[:, :2, :2]
        height = self._masses / (2 * np.pi * np.sqrt(np.linalg.det(planar)))
        if self._round:
            variance = planar[:, 0, 0, None]
            along_x1 = np.exp(-((x1 - position[:, :1]) ** 2) / (2 * variance))
            along_x2 = np.exp(-((x2 - position[:, 1:2]) ** 2) / (2 * variance))
            image += (height[:, None] * along_x2).T @ along_x1
            return image
        for value, (c1, c2, _), S in zip(height, position, planar, strict=True):
            image += _gaussian_image(np.array([[value]]), 0.5 * np.linalg.inv(S), x1 - c1, x2 - c2)
        return image

    @cached_property
    def _round(self) -> bool:
        variance = self.covariance[:, :1, 0, None]
        return bool(np.all(np.abs(self.covariance - variance * np.eye(3)) <= 1e-14 * variance))

    def fourier(self, k: Array, R: Array) -> NDArray[np.complex128]:
        """Return the reduced attenuation map J̃ (``eqRecMapReduced``) in closed form.

        Parameters
        ----------
        k:
            ``(..., 2)`` spatial frequencies [rad / length].
        R:
            ``(3, 3)`` rotation, lab to object.

        Returns
        -------
        NDArray
            ``(...)`` complex J̃(k) = √(2π) F₃[u](R Pᵀk) exp(i⟨R Pᵀk, C₃⟩).
        """
        q = k @ R[:, :2].T
        width = np.einsum("...i,bij,...j->...b", q, self.covariance, q)
        phase = q @ (self.position - self.center).T
        values: NDArray[np.complex128] = np.exp(-0.5 * width - 1j * phase) @ self._masses / (2 * np.pi)
        return values


@dataclass(frozen=True, eq=False)
class Grain(Phantom):
    """A sum of solid ellipsoids with sharp edges, u(x) = Σ ρ_e where (x − c_e)ᵀ A_e (x − c_e) ≤ 1.

    Attributes
    ----------
    step:
        ``(E,)`` what each ellipsoid adds to the density inside of it; negative for a cavity.
    position:
        ``(E, 3)`` centres c_e [length].
    form:
        ``(E, 3, 3)`` symmetric positive matrices A_e [1 / length²].
    oversampling:
        Points per pixel edge that are averaged, as a camera's pixel does; 1 samples at pixel centres.
    """

    step: Array
    position: Array
    form: Array
    oversampling: int = 1

    @classmethod
    def random(
        cls, rng: np.random.Generator, *, count: int = 0, radius: float = 5.0, oversampling: int = 2
    ) -> Grain:
        """Return a grain without symmetry: a wall of uneven thickness and `count` inclusions (0: 4 to 8)."""
        count = count or int(rng.integers(4, 9))
        semi_axes = np.array([1.0, rng.uniform(0.8, 0.9), rng.uniform(0.65, 0.78)])
        inner = semi_axes - rng.uniform(0.08, 0.14)
        shift = rng.uniform(-0.03, 0.03, 3)
        size = rng.uniform(0.08, 0.26, count)
        inclusions = size[:, None] * rng.uniform(0.6, 1.0, (count, 3))
        room = (inner - 0.03)[None] - size[:, None]
        position = np.vstack([np.zeros(3), shift, shift + room * _in_ball(rng, count)])
        half_axes = np.vstack([semi_axes, inner, inclusions])
        turn = np.concatenate([np.tile(np.eye(3), (2, 1, 1)), Rotation.random(count, rng=rng).as_matrix()])
        form = np.einsum("eij,ej,ekj->eik", turn, half_axes**-2.0, turn)
        step = np.concatenate([[1.0, -0.65], rng.uniform(0.4, 1.2, count)])
        whole = Rotation.random(rng=rng).as_matrix()
        grain = cls(step, position @ whole.T, whole @ form @ whole.T, oversampling)
        return grain._fitted(radius)

    @classmethod
    def sphere(cls, radius: float = 5.0, *, oversampling: int = 2) -> Grain:
        """Return a solid sphere about 0, whose rotation can't be seen at all."""
        return cls(np.ones(1), np.zeros((1, 3)), np.eye(3)[None] / radius**2, oversampling)

    def _fitted(self, radius: float) -> Grain:
        scale = radius / self.radius
        position = (self.position - self.center) * scale
        return Grain(self.step, position, self.form / scale**2, self.oversampling)

    @cached_property
    def _masses(self) -> Array:
        masses: Array = self.step * (4 * np.pi / 3) / np.sqrt(np.linalg.det(self.form))
        return masses

    @cached_property
    def center(self) -> Array:
        """Centre C₃."""
        center: Array = self._masses @ self.position / self._masses.sum()
        return center

    @property
    def mass(self) -> float:
        """∫ u dx."""
        return float(self._masses.sum())

    @cached_property
    def radius(self) -> float:
        """Radius of the support."""
        longest = np.linalg.eigvalsh(self.form)[:, 0] ** -0.5
        return float(np.max(np.linalg.norm(self.position - self.center, axis=1) + longest))

    def density(self, points: Array) -> Array:
        """Return u at ``(..., 3)`` points."""
        d = points[..., None, :] - self.position
        inside = np.einsum("...ei,eij,...ej->...e", d, self.form, d) <= 1.0
        values: Array = inside @ self.step
        return values

    def project(self, R: Array, T: Array, x1: Array, x2: Array) -> Array:
        """Return the ``(H, W)`` projection (``eq:J``)."""
        n = self.oversampling
        if n > 1:
            fine = self._sample(R, T, _subdivided(x1, n), _subdivided(x2, n))
            image: Array = fine.reshape(len(x2), n, len(x1), n).mean(axis=(1, 3))
            return image
        return self._sample(R, T, x1, x2)

    def _sample(self, R: Array, T: Array, x1: Array, x2: Array) -> Array:
        image = np.zeros((len(x2), len(x1)))
        position = self._lab(self.position, R, T)
        for step, (c1, c2, _), A in zip(self.step, position, self.form, strict=True):
            form, _, along = _complete_square(R.T @ A @ R)
            half = np.sqrt(np.diag(np.linalg.inv(form)))
            columns, rows = _window(x1 - c1, half[0]), _window(x2 - c2, half[1])
            a, b = (x1 - c1)[columns], ((x2 - c2)[rows])[:, None]
            chord = 1.0 - form[0, 0] * a**2 - form[1, 1] * b**2
            chord -= 2 * form[0, 1] * b * a
            np.maximum(chord, 0.0, out=chord)
            image[rows, columns] += step * 2.0 / np.sqrt(along) * np.sqrt(chord)
        return image


def _subdivided(x: Array, n: int) -> Array:
    """Coordinates of n evenly spread points in each of the pixels at `x`."""
    spacing = (x[-1] - x[0]) / (len(x) - 1)
    offsets = (np.arange(n) - 0.5 * (n - 1)) / n * spacing
    fine: Array = (x[:, None] + offsets).ravel()
    return fine


def _in_ball(rng: np.random.Generator, count: int) -> Array:
    """``(count, 3)`` points, uniform in the unit ball."""
    direction = rng.standard_normal((count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    points: Array = direction * rng.uniform(0.0, 1.0, (count, 1)) ** (1 / 3)
    return points
