"""A low-frequency model of the object, eliminated exactly: the likelihood of a motion.

The object is a sum of blobs on a body-centred cubic lattice, the sparsest that holds a ball of
frequencies (Petersen and Middleton 1962, DOI 10.1016/S0019-9958(62)90633-2); their amplitudes enter the
frames' low-frequency modes linearly and are solved for at every motion (variable projection; Golub and
Pereyra 2003, DOI 10.1088/0266-5611/19/2/201). What remains is the misfit of the motion alone. Each frame's
shift is eliminated with them, so that centring costs nothing. All sums over frames are non-uniform Fourier
transforms on the lattice. The real part of a mode sees only the part of the object that is even about the
centre, the imaginary part the odd one, so that the normal matrix falls into two blocks of half the size.

The object follows the noise as well: on the average the misfit lacks as much as the number of amplitudes that
the frames determine, tr A N⁻¹ Aᵀ, which grows with what a motion sees of Fourier space. Both together are
minimized; their mean over the noise does not favour motions that see more. What an amplitude has beside the
noise costs 1 / L in a prior of L times the right variance; where all views are from one side, and what is
seen depends on the motion most, that counts as well.

What the object holds of the noise turns with the motion as well. On the average it adds the same matrix T to
the normal matrix J of the motion and to the covariance of the gradient, as the noise in the object and the
noise that is left over are independent: the misfit bends by M = J − T only, and what the frames tell of the
motion is M J⁻¹ M (Godambe 1960, DOI 10.1214/aoms/1177705693). T is the normal matrix of objects that are
fitted to noise alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from operator import call
from typing import Any

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy.optimize import minimize

from trapcli.motion import triangular
from trapcli.motion.elimination import Eliminated, ObjectBlock, bent_blocks
from trapcli.motion.fourier_slices import back_project, conjugate_share, gather, project, slice_points
from trapcli.motion.integrate import interpolated
from trapcli.motion.low_band import LowBand
from trapcli.motion.object_prior import Prior
from trapcli.motion.path import Path, Spline, cross_matrix
from trapcli.motion.roughness import Roughness
from trapcli.threads import in_parallel, processors

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

GUARDS = (3.0, 4.5, 6.0)
"""Guards of the lattice that are tried, see `ObjectModel`."""

LOOSE = 4.0
"""Variance of a prior over the likeliest: edges are no samples of it, and must not be smoothed away."""

_COARSE_BAND = 12.0  # band times radius of a model that only tells right motions from wrong ones
_MARGIN = 0.3  # lattice beyond the object's radius, in units of `spacing`
_WIDTH = 0.4  # width of a blob in units of `spacing`, where it is not known
_TYPICAL = 0.08, 0.02  # width of blobs over the object's radius, power over that of the strongest mode
_BELIEVABLE = ((-7.0, 0.0), (-14.0, 2.3))  # ranges of them: what no prior explains wants no end of power
_SEARCH = (
    (12.0, ((0.0, 0.0), (0.4, 0.0), (0.0, 1.0)), 20),
    (np.inf, ((0.0, 0.0), (0.2, 0.0), (0.0, -0.5)), 10),
)  # for the likeliest, roughly at first: band times radius up to which it explains, simplex, looks
_PLACINGS = 4  # times that it is told where the object lies
_PROBES = 2  # objects that are fitted to noise alone
_NEAR = 1.5  # misfit per degree of freedom up to which it may tell kicks from a wrong motion
_MOST_NOISE = 0.9  # share that noise may have of a normal matrix
_FIXED_GAUGE = 10.0  # stiffness of the free orientation, in units of the mean curvature
_ROUNDING = 1e-9  # stiffness of what nothing tells, in the same units
_STEPS = 10
_CONVERGED = 0.1  # gain in misfit, in units of a noise's, that ends the search
_FAITHFUL = 1e-10  # accuracy of the modes of an object: far below noise of 0.1 % of the peak
_AT_ONCE = 64  # frames whose waves on the lattice are held at once
_CACHED = 256  # lattice points whose waves fit into a processor's cache


@dataclass(frozen=True)
class Fit:
    """A motion fitted to the frames' low band.

    Attributes
    ----------
    path:
        R and ω at the times that were asked for, followed by the spline's grid and the G group times.
    low:
        The data, centred as the model wants them.
    shift:
        ``(G, 2)`` by how much the centres moved [length].
    spline:
        What bent the path.
    cost:
        Misfit to the data.
    roughness:
        What counted beside the misfit; None where the spline alone smoothes.
    axes:
        Lab axes about which the path was bent.
    model:
        What was fitted, about the centres that the data had before.
    known:
        Its normal equations at the motion, where the search has told them.
    """

    path: Path
    low: LowBand
    shift: Array
    spline: Spline
    cost: float
    roughness: Roughness | None
    axes: tuple[int, ...]
    model: ObjectModel
    known: Normal | None = None

    @property
    def R(self) -> Array:
        """``(G, 3, 3)`` rotations of the groups."""
        return self.path.R[-len(self.low.time) :]

    @cached_property
    def normal(self) -> Normal:
        """The model's normal equations at the motion."""
        return self.known or self.model.normal(self)


@dataclass(frozen=True)
class Assessment:
    """How well a fit fits and how far it can be trusted.

    Attributes
    ----------
    degrees:
        Expected misfit: ``fit.cost / degrees`` is 1 where the noise explains it.
    parameters:
        How many numbers of the motion the frames determine.
    covariance:
        ``(size, 3, size, 3)`` covariance of the spline's coefficients.
    frame_misfit, mode_misfit:
        ``(G,)`` and ``(K,)`` misfit of each frame and of each mode in units of its noise.
    middle:
        ``(3,)`` centre of the object from the origin of the model, in object coordinates [length].
    """

    degrees: float
    parameters: float
    covariance: Array
    frame_misfit: Array
    mode_misfit: Array
    middle: Array


class ObjectModel:
    """Normal equations of the object's amplitudes for any motion.

    Parameters
    ----------
    low:
        Modes of G frames; those beyond `band` are not used.
    band:
        Highest spatial frequency [rad / length].
    guard:
        Half the gap between the band and its periodic image, times the object's radius: the wider, the finer
        the lattice, and the sharper the edges that it can show.
    prior:
        What the object may be like; None where that is not known.
    variance:
        ``(K,)`` noise of each mode of `low`, model error included; None for white noise.
    weights:
        ``(G,)`` weight of each frame.
    """

    def __init__(
        self,
        low: LowBand,
        band: float,
        *,
        guard: float = GUARDS[-1],
        prior: Prior | None = None,
        variance: Array | None = None,
        weights: Array | None = None,
    ) -> None:
        inside = low.inside(band)
        self.low = replace(low, k=low.k[inside], modes=low.modes[:, inside])
        self.band, self.guard, self.prior = band, guard, prior
        self.variance = np.full(inside.sum(), low.variance) if variance is None else variance[inside]
        self.weights = np.ones(len(low.time)) if weights is None else weights
        self._share = conjugate_share(self.low.k)
        self._root = np.sqrt(self.weights[:, None] * self._share / self.variance)
        # of a cubic lattice that repeats the spectrum as far away as the body-centred one does
        spacing = np.pi / (band + guard / low.radius)
        self.spacing = spacing / np.sqrt(2)
        reach = low.radius + _MARGIN * spacing
        self._half = int(reach / self.spacing)
        axis = np.arange(-self._half, self._half + 1)
        cube = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
        odd = cube % 2 == 1
        centred = odd.all(axis=-1) | ~odd.any(axis=-1)
        self._mask = centred & (np.linalg.norm(cube, axis=-1) * self.spacing <= reach)
        self._index = cube[self._mask]
        self.position = self._index * self.spacing
        self._half_index = self._index[: len(self._index) // 2 + 1]  # one point of each opposite pair
        radial = np.hypot(self.low.k[:, 0], self.low.k[:, 1])
        expected = prior or Prior.vague(self.low, _WIDTH * spacing, self.variance)
        self._blob = expected.spectrum(radial) / np.sqrt(len(self._index))
        precision = 1 / expected.variance(self.position)
        # mean lack of the misfit for each amplitude that is seen: an amplitude has its share of the prior
        self._lacking = 1 - 1 / expected.looseness
        # of opposite points alike
        self._precision = precision[: len(self._half_index)], precision[: len(self._half_index) - 1]
        self._gain = self._root * self._blob
        # places of differences and sums of lattice points among all, for one point of each opposite pair
        edge = 4 * self._half + 1
        flat = self._half_index @ np.array([edge**2, edge, 1])
        middle = 2 * self._half * (edge**2 + edge + 1)
        self._difference = flat[:, None] - flat[None, :] + middle
        self._sum = flat[:, None] + flat[None, :] + middle

    @classmethod
    def coarse(cls, low: LowBand, band: float, guard: float = GUARDS[-1]) -> ObjectModel:
        """Return a model that is quickly fitted, of `band` at most: it tells right motions from wrong."""
        return cls(low, min(band, _COARSE_BAND / low.radius), guard=guard)

    @classmethod
    def after(cls, fit: Fit, assessment: Assessment, band: float) -> ObjectModel:
        """Return the model whose noise is raised, mode by mode, to what a fit has left over."""
        variance = fit.low.variance * np.maximum(assessment.mode_misfit, 1.0)
        return cls(fit.low, band, guard=fit.model.guard, prior=fit.model.prior, variance=variance)

    @classmethod
    def likeliest(
        cls, low: LowBand, band: float, R: Array, looseness: float = np.inf, sharp: bool | None = None
    ) -> ObjectModel:
        """Return the model that explains ``(G, 3, 3)`` rotations best, in as few amplitudes as it takes.

        The prior is told by its evidence on the finest lattice; the guard then by Akaike's criterion (1974,
        DOI 10.1109/TAC.1974.1100705): a smooth object needs a coarser lattice than one with sharp edges.
        Whether the object is `sharp` is told by its evidence as well, where that is not known.
        """
        forms = (True, False) if sharp is None else (sharp,)
        told = in_parallel(lambda form: cls._likeliest_prior(low, band, GUARDS[-1], R, sharp=form), forms)
        prior, _ = min(told, key=lambda one: one[1])
        prior = replace(prior, looseness=looseness)

        def surprise(model: ObjectModel) -> float:
            views = model.views(R)
            return model._cost(views, model.low.modes) + 2 * views.seen

        models = [cls(low, band, guard=guard, prior=prior) for guard in GUARDS]
        return models[int(np.argmin(in_parallel(surprise, models)))]

    @classmethod
    def _likeliest_prior(
        cls,
        low: LowBand,
        band: float,
        guard: float,
        R: Array,
        *,
        sharp: bool,
        rounds: int = len(_SEARCH),
    ) -> tuple[Prior, float]:
        """Return the likeliest prior of a form, and how surprising the frames are with it."""
        about = Prior.of(low, sharp=sharp)

        def prior(logarithms: Array) -> Prior:
            width, power = np.exp(logarithms)
            return replace(about, width=width * low.radius, power=power * about.power)

        def surprise(logarithms: Array, band: float) -> float:
            model = cls(low, band, guard=guard, prior=prior(logarithms))
            views = model.views(R)
            return model._cost(views, model.low.modes) + views.volume

        best = np.log(_TYPICAL)
        for highest, spread, looks in _SEARCH[:rounds]:
            found = minimize(
                surprise,
                best,
                args=(min(band, highest / low.radius),),
                method="Nelder-Mead",
                bounds=_BELIEVABLE,
                options={
                    "initial_simplex": best + np.array(spread),
                    "xatol": 0.1,
                    "fatol": 1.0,
                    "maxfev": looks,
                },
            )
            best = found.x
        likeliest = prior(best)
        return replace(likeliest, power=LOOSE * likeliest.power), float(found.fun)

    def roughly_told(self, fit: Fit) -> ObjectModel:
        """Return the model whose prior low frequencies alone tell, and from there the others by its form."""
        assert self.prior is not None
        sharp = self.prior.sharp
        prior, _ = self._likeliest_prior(self.low, self.band, self.guard, fit.R, sharp=sharp, rounds=1)
        return self._with(replace(prior, looseness=self.prior.looseness))

    def placed(self, fit: Fit) -> ObjectModel:
        """Return the model whose prior says where the object of a fit lies.

        Told by the evidence, like the prior itself, and loosened then.
        """
        assert self.prior is not None

        prior = replace(self.prior, power=self.prior.power / LOOSE)
        for _ in range(_PLACINGS):
            tight = self._with(prior)
            views = tight.views(fit.R)
            amplitude = tight._solved(views, fit.low.modes).amplitude
            prior = prior.placed(self.low, self.position, amplitude**2, views.spread)
        return self._with(replace(prior, power=LOOSE * prior.power))

    def score(self, fit: Fit) -> float:
        """Return the misfit of this model at a fit's motion less what is expected, but for what all share."""
        views = self.views(fit.R)
        return self._misfit(self._solved(views, fit.low.modes)) + views.seen

    def _with(self, prior: Prior) -> ObjectModel:
        return ObjectModel(self.low, self.band, guard=self.guard, prior=prior, variance=self.variance)

    @property
    def sharp(self) -> bool | None:
        """Whether the object is taken to have edges; None where nothing is known of it."""
        return None if self.prior is None else self.prior.sharp

    @property
    def data_count(self) -> float:
        """Real numbers that the frames hold, by their weights."""
        return float(self._share.sum() * self.weights.sum())

    def cost(self, R: Array, modes: ComplexArray) -> float:
        """Return the misfit of ``(G, 3, 3)`` rotations to ``(G, K)`` modes, the object eliminated."""
        return self._cost(self.views(R), modes)

    def fit(
        self,
        path: Path,
        times: Array,
        spline: Spline,
        *,
        smooth: bool = True,
        axes: tuple[int, ...] = (0, 1, 2),
        steps: int = _STEPS,
    ) -> Fit:
        """Bend `path` to the least unbiased misfit (Gauss–Newton on the projected misfit).

        Parameters
        ----------
        path:
            R and ω at the times asked for, followed by the spline's grid and the G group times.
        times:
            The G group times.
        spline:
            What bends the path.
        smooth:
            Whether roughness of ω counts, with a weight found from the data.
        axes:
            Lab axes about which the path is bent.
        """
        groups = len(times)
        values = spline.values(times)
        told, formed = Roughness(spline, axes), False
        roughness: Roughness | None = None
        bent = _coefficients(spline, axes)
        now = self._tried(path, np.zeros((groups, 2)))
        normal: Normal | None = None
        by_noise: Array | None = None
        for _ in range(steps):
            state = self._linearized(now.views, now.modes, now.solution)
            seen_slopes, eliminated = in_parallel(
                call,
                (
                    partial(self._seen_slopes, now.views),
                    partial(self._eliminated, now.views, state, values),
                ),
            )
            if by_noise is None:
                by_noise = self._noise_hessian(now.views, state, eliminated, values)
            downhill, still, hope = self._downhill(now.views, state, eliminated, seen_slopes, values)
            hessian = _pinned(eliminated.hessian, now.views.R, values)[np.ix_(bent, bent)]
            informed = _informed(hessian, by_noise[np.ix_(bent, bent)])
            hessian, downhill = informed @ hessian @ informed.T, informed @ downhill[bent]
            if smooth:
                # far from the motion the misfit is large, and must not call for wiggles
                excess = max(1.0, state.cost / self._degrees(groups))
                change = hessian / excess, downhill / excess, now.path, groups
                if excess < _NEAR and not formed:
                    told, formed = Roughness(spline, axes).formed(*change), True
                told = told.weighed(*change)
                roughness = replace(told, weight=excess * told.weight)
                hessian += roughness.curvature(now.path, groups)
                downhill -= roughness.uphill(now.path, groups)
            step = np.zeros((spline.size, 3))
            step.flat[bent] = np.linalg.solve(hessian, downhill)
            hope += float(downhill @ step.flat[bent])
            if hope < _CONVERGED:
                normal = Normal(now.views, state, eliminated, by_noise)
                break
            follow = self._follow(
                now.views, state, eliminated, values @ step, eliminated.solution @ step.ravel()
            )
            gain, now = self._search(now, spline, step, still, follow, roughness)
            if gain < _CONVERGED:
                break
        low, misfit = self.low.shifted(now.shift), self._misfit(now.solution)
        return Fit(now.path, low, now.shift, spline, misfit, roughness, axes, self, normal)

    def again(self, fit: Fit, path: Path | None = None) -> tuple[Fit, Assessment]:
        """Go on from a fit by another model of the same frames, or from another path in its stead."""
        smooth = fit.roughness is not None
        again = self.fit(path or fit.path, self.low.time, fit.spline, smooth=smooth, axes=fit.axes)
        return again, self.assess(again)

    def _degrees(self, groups: int) -> float:
        """Return roughly the misfit to be expected of the right motion."""
        return max(self.data_count - len(self.position) - 2 * groups, 0.1 * self.data_count)

    def assess(self, fit: Fit) -> Assessment:
        """Return degrees of freedom, covariance and the misfit of each frame and mode of a fit."""
        values = fit.spline.values(fit.low.time)
        normal = fit.normal
        views, state, hessian = normal.views, normal.state, normal.eliminated.hessian
        size = values.shape[1]
        bent = np.ix_(*2 * (_coefficients(fit.spline, fit.axes),))
        known = _pinned(hessian, views.R, values)[bent]
        rough = 0.0 if fit.roughness is None else fit.roughness.curvature(fit.path, len(values))
        parameters = float(np.trace(np.linalg.solve(known + rough, hessian[bent])))
        informed = _informed(known, normal.by_noise[bent])
        covariance = np.zeros_like(hessian)
        covariance[bent] = np.linalg.inv(informed @ known @ informed.T + rough)
        degrees = max(self.data_count - views.seen - parameters - 2 * self.weights.sum(), 1.0)
        power = np.abs(state.residual) ** 2 * self.data_count / degrees
        return Assessment(
            degrees=degrees,
            parameters=parameters,
            covariance=covariance.reshape(size, 3, size, 3),
            frame_misfit=power.sum(axis=1) / (self._share.sum() * np.maximum(self.weights, 1e-300)),
            mode_misfit=power.sum(axis=0) / (self._share * self.weights.sum()),
            middle=self._middle(state),
        )

    def normal(self, fit: Fit) -> Normal:
        """Return the normal equations at a fit of this model."""
        values = fit.spline.values(fit.low.time)
        views = self.views(fit.R)
        state = self._state(views, fit.low.modes)
        eliminated = self._eliminated(views, state, values)
        return Normal(views, state, eliminated, self._noise_hessian(views, state, eliminated, values))

    def locate(self, fit: Fit, covariance: Array, R: Array, low: LowBand) -> tuple[Array, Array]:
        """Find the middle of the fitted object in single frames.

        Parameters
        ----------
        fit:
            A motion of the G groups, fitted by this model.
        covariance:
            ``(size, 3, size, 3)`` of the coefficients of its spline.
        R:
            ``(N, 3, 3)`` rotations of N frames.
        low:
            Their modes, about the centres that the groups had before the fit.

        Returns
        -------
        place, errors:
            ``(N, 2)`` from those centres, and 1-σ errors of the way from the first frame [length].
        """
        state = fit.normal.state
        moved = interpolated(low.time, fit.low.time, fit.shift)
        modes = low.modes[:, : len(self.low.k)] * np.exp(1j * moved @ self.low.k.T)
        noise = self.variance * (low.variance / self.low.variance)
        points = slice_points(R, self.low.k, self.spacing)
        model, slopes = self._model(R, points, state.amplitude)
        root = np.sqrt(self._share / noise)
        shifts = slopes[..., 3:] * root[:, None]
        own = _shift_covariance(shifts)
        down = np.einsum("gki,gk->gi", shifts.conj(), (modes - model) * root).real
        place = moved + np.einsum("gij,gj->gi", own, down)
        place += np.einsum("gji,j->gi", R, self._middle(state))[:, :2]
        alone = np.diagonal(own, axis1=1, axis2=2) + np.diag(own[0])
        alone[0] = 0.0
        common = self._common_errors(fit.normal, fit.spline.values(fit.low.time), covariance)
        return place, np.sqrt(alone + interpolated(low.time, fit.low.time, common) ** 2)

    def _common_errors(self, normal: Normal, values: Array, covariance: Array) -> Array:
        """Return ``(G, 2)`` errors of the way from the first group that object and motion cause [length]."""
        views, state, eliminated = normal.views, normal.state, normal.eliminated
        middle = self._middle(state)
        arm = (self.position - middle) / state.amplitude.sum()
        lever = np.stack([np.concatenate(_folded(column)) for column in arm.T], axis=1)
        flat = covariance.reshape(2 * (3 * values.shape[1],))
        first: list[Array] = []
        errors = np.zeros((len(values), 2))
        for part, column in self._columns(views, state.slopes[..., 3:]):
            R = views.R[part]
            # the centre is the shift and the middle, which follow the object and the motion
            pulled = lever @ R[:, :, :2] - column @ eliminated.shift_covariance[part]
            turned = cross_matrix(middle @ R)[:, :2] - eliminated.carry[part].transpose(0, 2, 1)
            by_object = pulled.transpose(1, 0, 2)
            followed = eliminated.block.solve(by_object.reshape(len(by_object), -1)).reshape(by_object.shape)
            by_motion = np.einsum("gb,gij->gibj", values[part], turned).reshape(*turned.shape[:2], -1)
            by_motion -= np.einsum("ngi,np->gip", by_object, eliminated.solution, optimize=True)
            first = first or [by_object[:, :1], followed[:, :1], by_motion[:1]]
            way, answer, turn = by_object - first[0], followed - first[1], by_motion - first[2]
            errors[part] = np.einsum("ngi,ngi->gi", way, answer)
            errors[part] += np.einsum("gip,pq,giq->gi", turn, flat, turn, optimize=True)
        return np.sqrt(np.maximum(errors, 0.0))

    # ------------------------------------------------------------------ one motion

    def _square(self, modes: ComplexArray) -> float:
        return float(np.sum(np.abs(self._root * modes) ** 2))

    def views(self, R: Array) -> Views:
        """Return what the orientations alone decide: where the frames look, and the normal matrix."""
        points = slice_points(R, self.low.k, self.spacing)
        density = (self._gain**2).ravel().astype(complex)
        # the normal matrix spans ten orders of magnitude, and so must the transforms
        kernel = back_project(points, density, 4 * self._half + 1).ravel()
        across, along = kernel[self._sum], kernel[self._difference]
        even, odd = along + across, along[:-1, :-1] - across[:-1, :-1]
        even[-1] *= np.sqrt(0.5)  # the point in the middle is its own opposite
        even[:, -1] *= np.sqrt(0.5)
        for block, precision in zip((even, odd), self._precision, strict=True):
            block[np.diag_indices(len(block))] += precision
        blocks = [even.copy(), odd.copy()] if ObjectBlock.is_dense(len(self.position), 2 * len(R)) else None
        halves = in_parallel(triangular.inverse_factor, (even.T, odd.T))
        # not the trace of N⁻¹ A Aᵀ, of which rounding would leave little
        unseen = (np.sum(half**2, axis=0) @ own for half, own in zip(halves, self._precision, strict=True))
        seen = float(len(self.position) - sum(unseen))
        return Views(R, points, halves, blocks, seen)

    def _seen_slopes(self, views: Views) -> Array:
        """Return the ``(G, 3)`` derivatives of ``views.seen`` by small rotations ε, ``R → R exp([ε]×)``.

        With D the precision of the prior d tr(1 − N⁻¹ D) = tr(N⁻¹ D N⁻¹ dN), a sum over differences of
        lattice points.
        """
        even, odd = in_parallel(_twice_inverse, views.halves, self._precision)
        odd = np.pad(odd, (0, 1))
        for lower in (even, odd):  # stands for both triangles
            lower[np.diag_indices(len(lower))] *= 0.5
        even[-1] *= np.sqrt(0.5)
        even[:, -1] *= np.sqrt(0.5)
        edge = 4 * self._half + 1
        total = np.bincount(self._difference.ravel(), (even + odd).ravel(), edge**3)
        total += np.bincount(self._sum.ravel(), (even - odd).ravel(), edge**3)
        cube = total.reshape(edge, edge, edge)
        cube += cube[::-1, ::-1, ::-1]
        place = self.spacing * np.arange(-2 * self._half, 2 * self._half + 1)
        # transforms of odd real numbers are imaginary: two fit into one
        along = np.stack([cube * place[:, None, None] + 1j * cube * place[:, None], cube * place])
        two, third = project(views.points, along, _FAITHFUL).reshape(2, *self._root.shape)
        slopes = np.stack([two.imag, -two.real, third.imag])
        turned = _turning(views.R, self.low.k, slopes * self._gain**2)
        return np.asarray(turned.sum(axis=1))

    def right(self, views: Views, whitened: ComplexArray) -> Array:
        """Return ``(n,)`` products of all waves of the amplitudes with whitened ``(G, K)`` modes."""
        waves = (self._gain * whitened).ravel()
        lattice = back_project(views.points, waves, 2 * self._half + 1)
        return np.asarray(lattice[self._mask])

    def alone(self, views: Views, whitened: ComplexArray) -> Array:
        """Return ``(n, 2 K)`` products of all waves with each of whitened ``(G, K)`` modes alone.

        First with the modes, then with i times the modes.
        """
        waves = self._gain * whitened

        def sums(mode: int) -> ComplexArray:
            points = [axis.reshape(waves.shape)[:, mode].copy() for axis in views.points]
            lattice = gather(points, waves[:, mode].copy(), 2 * self._half + 1, _FAITHFUL)
            return np.asarray(lattice[self._mask])

        every = np.stack(in_parallel(sums, range(waves.shape[1])), axis=1)
        return np.concatenate([every.real, -every.imag], axis=1)

    def _waves(self, points: list[Array], amplitudes: list[Array]) -> ComplexArray:
        """Return ``(A, G, K)`` modes of A sets of ``(n,)`` amplitudes."""
        volume = np.zeros((len(amplitudes), *self._mask.shape), complex)
        volume[:, self._mask] = amplitudes
        values = project(points, volume, _FAITHFUL)
        return np.asarray(self._blob * values.reshape(len(amplitudes), -1, len(self._blob)))

    def _tried(self, path: Path, shift: Array) -> _Tried:
        views = self.views(path.R[-len(shift) :])
        modes = self.low.shifted(shift).modes
        return _Tried(path, shift, views, modes, self._solved(views, modes))

    def _cost(self, views: Views, modes: ComplexArray) -> float:
        return self._solved(views, modes).cost

    def _solved(self, views: Views, modes: ComplexArray) -> _Solution:
        right = self.right(views, self._root * modes)
        amplitude = views.solve(right)
        return _Solution(amplitude, self._square(modes) - float(right @ amplitude))

    def _misfit(self, solution: _Solution) -> float:
        """Return the squares of the residuals alone, without what the prior adds."""
        parts = zip(_folded(solution.amplitude), self._precision, strict=True)
        return solution.cost - float(sum(part**2 @ precision for part, precision in parts))

    def _state(self, views: Views, modes: ComplexArray) -> _State:
        """Solve for the object; return what the gradient needs."""
        return self._linearized(views, modes, self._solved(views, modes))

    def _linearized(self, views: Views, modes: ComplexArray, solution: _Solution) -> _State:
        model, slopes = self._model(views.R, views.points, solution.amplitude)
        residual = (modes - model) * self._root
        return _State(solution.amplitude, residual, slopes * self._root[..., None], solution.cost)

    def _middle(self, state: _State) -> Array:
        return np.asarray(state.amplitude @ self.position / state.amplitude.sum())

    def _model(self, R: Array, points: list[Array], amplitude: Array) -> tuple[ComplexArray, ComplexArray]:
        """Return ``(G, K)`` modes and their ``(G, K, 5)`` slopes by rotation and shift."""
        model, *gradient = self._waves(points, [amplitude, *(amplitude * self.position.T)])
        slopes = -1j * _turning(R, self.low.k, np.array(gradient))
        k1, k2 = self.low.k.T
        shifts = np.stack([-1j * k1 * model, -1j * k2 * model], axis=-1)
        return model, np.concatenate([slopes, shifts], axis=-1)

    def _downhill(
        self, views: Views, state: _State, eliminated: Eliminated, seen_slopes: Array, values: Array
    ) -> tuple[Array, Array, float]:
        """Return half the gradient, ``(P,)``, and ``(G, 2)`` shifts, where the object and the shifts follow.

        The shifts are those that lessen the misfit most while the motion stays; by how much comes last.
        """
        gradient = np.einsum("gki,gk->gi", state.slopes.conj(), state.residual).real
        turning, shifting = gradient[:, :3] - 0.5 * self._lacking * seen_slopes, gradient[:, 3:]
        turning -= np.einsum("gij,gj->gi", eliminated.carry, shifting)
        alone = np.einsum("gij,gj->gi", eliminated.shift_covariance, shifting)
        pull = self.right(views, np.einsum("gki,gi->gk", state.slopes[..., 3:], alone))
        pull = np.concatenate(_folded(pull))
        downhill = (values.T @ turning).ravel() + pull @ eliminated.solution
        answer = eliminated.block.solve(pull[:, None])[:, 0]
        still = alone + self._follow(views, state, eliminated, np.zeros((len(values), 3)), answer)
        return downhill, _without_drift(still, views.R), float(np.sum(shifting * still))

    def _follow(
        self, views: Views, state: _State, eliminated: Eliminated, turn: Array, answer: Array
    ) -> Array:
        """Return the ``(G, 2)`` shifts that follow ``(G, 3)`` turns and minus an ``(n,)`` folded object."""
        waves = self._root * self._waves(views.points, [_unfolded(answer)])[0]
        pull = np.einsum("gki,gk->gi", state.slopes[..., 3:].conj(), waves).real
        pull = np.einsum("gij,gj->gi", eliminated.shift_covariance, pull)
        return _without_drift(pull - np.einsum("gji,gj->gi", eliminated.carry, turn), views.R)

    def _search(
        self,
        now: _Tried,
        spline: Spline,
        step: Array,
        still: Array,
        follow: Array,
        roughness: Roughness | None,
    ) -> tuple[float, _Tried]:
        """Return the gain of the Newton step, shortened until it helps, and where it leads to."""

        def total(tried: _Tried) -> float:
            rough = 0.0 if roughness is None else roughness.penalty(tried.path, len(still))
            return tried.solution.cost + self._lacking * tried.views.seen + rough

        old = total(now)
        for length in 0.25 ** np.arange(6):
            tried = self._tried(now.path.bent(spline, length * step), now.shift + still + length * follow)
            gain = old - total(tried)
            if gain > 0:
                return gain, tried
        return 0.0, now

    def _eliminated(self, views: Views, state: _State, values: Array) -> Eliminated:
        """Eliminate the object and the shifts from the normal equations of a motion."""
        turns, shifts = state.slopes[..., :3], state.slopes[..., 3:]
        inverse = _shift_covariance(shifts)
        carry, alone = _without_shifts(turns, shifts, inverse)
        every = np.concatenate([alone, shifts @ np.linalg.cholesky(inverse)], axis=-1)
        coupling = np.zeros((values.shape[1], len(self.position), 3))

        def parts() -> Iterator[Array]:
            for part, column in self._columns(views, every):
                _add_bent(coupling, values[part], column[..., :3])
                yield np.asfortranarray(column[..., 3:].transpose(1, 0, 2).reshape(len(self.position), -1))

        block = ObjectBlock(views.halves, parts(), 2 * len(values), views.blocks)
        hessian, solution = _without_object(values, alone, coupling, block)
        return Eliminated(hessian, solution, block, inverse, carry)

    def _noise_hessian(self, views: Views, state: _State, eliminated: Eliminated, values: Array) -> Array:
        """Return the ``(P, P)`` mean normal matrix of a motion of objects that are fitted to noise alone."""
        rng = np.random.default_rng(0)

        def probe() -> ComplexArray:
            """Return the ``(G, K, 3)`` slopes by rotation of an object that is fitted to noise."""
            real, imaginary = rng.standard_normal((2, *self._root.shape))
            # a mode that stands for itself alone is real
            noise = real + 1j * (self._share > 1) * imaginary
            _, slopes = self._model(views.R, views.points, views.solve(self.right(views, noise)))
            turns = slopes[..., :3] * self._root[..., None]
            return _without_shifts(turns, state.slopes[..., 3:], eliminated.shift_covariance)[1]

        alone = np.concatenate([probe() for _ in range(_PROBES)], axis=-1)
        coupling = np.zeros((values.shape[1], len(self.position), alone.shape[-1]))
        for part, column in self._columns(views, alone):
            _add_bent(coupling, values[part], column)
        return _without_object(values, alone, coupling, eliminated.block)[0] / _PROBES

    def _columns(self, views: Views, whitened: ComplexArray) -> Iterator[tuple[slice, Array]]:
        """Yield parts of the frames with the ``(g, n, C)`` products of all waves and ``(G, K, C)`` modes."""
        parts, at_once = list(_parts(len(whitened))), processors()
        for start in range(0, len(parts), at_once):
            now = parts[start : start + at_once]
            modes = (whitened[part] * self._gain[part, :, None] for part in now)
            R = (views.R[part] for part in now)
            yield from zip(now, in_parallel(self._back_projected, R, modes), strict=True)

    def _back_projected(self, R: Array, modes: ComplexArray) -> Array:
        """Return ``(g, n, C)`` sums ``Re Σ_k exp(i⟨R k, b⟩) modes`` of ``(g, K, C)`` modes, folded."""
        count = len(self._half_index)
        i1, i2, i3 = (self._half_index + self._half).T
        folded = np.empty((len(R), 2 * count - 1, modes.shape[-1]))
        both = np.empty((2, count, modes.shape[-1]))
        for n, rotation in enumerate(R):
            # exp(i⟨R k, b⟩) is a product of powers, one for each axis
            unit = np.exp(1j * self.spacing * (rotation[:, :2] @ self.low.k.T))
            up = np.cumprod(np.broadcast_to(unit, (self._half, *unit.shape)), axis=0)
            power = np.concatenate([up[::-1].conj(), np.ones_like(up[:1]), up]).transpose(1, 0, 2)
            real, imaginary = modes[n].real.copy(), modes[n].imag.copy()
            for start in range(0, count, _CACHED):
                here = slice(start, start + _CACHED)
                wave = power[0].take(i1[here], axis=0)
                wave *= power[1].take(i2[here], axis=0)
                wave *= power[2].take(i3[here], axis=0)
                np.matmul(wave.real.copy(), real, out=both[0, here])
                np.matmul(wave.imag.copy(), imaginary, out=both[1, here])
            folded[n, :count] = np.sqrt(2) * both[0]
            folded[n, count - 1] = both[0, -1]
            folded[n, count:] = -np.sqrt(2) * both[1, :-1]
        return folded


def refitted(low: LowBand, fit: Fit, path: Path, looseness: float = np.inf) -> tuple[Fit, Assessment]:
    """Fit again from another path, with the likeliest model along it.

    Parameters
    ----------
    low:
        The frames, with all modes.
    fit:
        Says the band, the spline, the axes and whether roughness counts.
    path:
        Where to start, at the times of that of `fit`.
    looseness:
        Of the prior.
    """
    R = path.R[-len(low.time) :]
    model = ObjectModel.likeliest(low, fit.model.band, R, looseness, fit.model.sharp)
    return model.again(fit, path)


@dataclass(frozen=True)
class Views:
    """Orientations of the frames: their modes' places in units of the lattice, the object's normal matrix.

    The matrix is of folded amplitudes, an even block and an odd one. `halves` are the inverses of their lower
    Cholesky factors; the `blocks` themselves are there where `ObjectBlock` wants them. `seen` is how many
    amplitudes the frames determine.
    """

    R: Array
    points: list[Array]
    halves: list[Array]
    blocks: list[Array] | None
    seen: float

    @property
    def volume(self) -> float:
        """Logarithm of the determinant of the object's normal matrix."""
        return -2 * float(sum(np.log(np.diag(half)).sum() for half in self.halves))

    @property
    def spread(self) -> Array:
        """``(n,)`` variances that the frames and the prior leave the amplitudes."""
        even, odd = (np.sum(half**2, axis=0) for half in self.halves)
        both = 0.5 * (even[:-1] + odd)
        return np.concatenate([both, even[-1:], both[::-1]])

    def solve(self, right: Array) -> Array:
        """Return the ``(n,)`` amplitudes for an ``(n,)`` right-hand side."""
        halves = [half.T @ (half @ part) for half, part in zip(self.halves, _folded(right), strict=True)]
        return _unfolded(np.concatenate(halves))

    def lessened(self, right: Array) -> Array:
        """Return ``(n, ...)`` L⁻¹ times right-hand sides; the object explains the squares of its columns."""
        halves = [half @ part for half, part in zip(self.halves, _folded(right), strict=True)]
        return np.concatenate(halves)


@dataclass(frozen=True)
class _Solution:
    """The object that fits a motion best, as ``(n,)`` amplitudes, and its misfit to data and prior."""

    amplitude: Array
    cost: float


@dataclass(frozen=True)
class _Tried:
    """A motion with shifts, the modes that these have moved, and the object that fits them."""

    path: Path
    shift: Array
    views: Views
    modes: ComplexArray
    solution: _Solution


def _twice_inverse(half: Array, precision: Array) -> Array:
    """Return the lower triangle of N⁻¹ D N⁻¹, from the inverse of the lower Cholesky factor of N."""
    inverse = triangular.squared(half)
    inverse += np.tril(inverse, -1).T
    inverse *= np.sqrt(precision)
    return -triangular.less_square(np.zeros_like(inverse), inverse)


def _turning(R: Array, k: Array, gradient: NDArray[Any]) -> NDArray[Any]:
    """Turn ``(3, G, K)`` gradients at R Pᵀk into ``(G, K, 3)`` derivatives by ε, ``R → R exp([ε]×)``.

    The mode at R Pᵀk moves by R (ε × Pᵀk).
    """
    g1, g2, g3 = np.einsum("gji,jgk->igk", R, gradient)
    k1, k2 = k.T
    return np.stack([k2 * g3, -k1 * g3, k1 * g2 - k2 * g1], axis=-1)


def _folded(lattice: Array) -> tuple[Array, Array]:
    """Return ``(n, ...)`` numbers on the lattice as their even and odd parts, normalized.

    Point n − 1 − i lies opposite to point i; the one in the middle ends the even part.
    """
    half = len(lattice) // 2
    first, opposite = lattice[:half], lattice[:half:-1]
    even = np.concatenate([np.sqrt(0.5) * (first + opposite), lattice[half : half + 1]])
    return even, np.sqrt(0.5) * (first - opposite)


def _unfolded(parts: Array) -> Array:
    """Return numbers on the lattice from their even part, followed by the odd one."""
    half = len(parts) // 2
    even, odd = parts[:half], parts[half + 1 :]
    opposite = np.sqrt(0.5) * np.stack([even + odd, even - odd])
    return np.concatenate([opposite[0], parts[half : half + 1], opposite[1, ::-1]])


def _without_drift(shift: Array, R: Array) -> Array:
    """Return ``(G, 2)`` shifts without those that a shift of the object undoes: steps would creep there."""
    drift = R[:, :, :2].transpose(0, 2, 1).reshape(-1, 3)
    return shift - (drift @ np.linalg.lstsq(drift, shift.ravel(), rcond=None)[0]).reshape(shift.shape)


def _parts(count: int) -> Iterator[slice]:
    return (slice(start, start + _AT_ONCE) for start in range(0, count, _AT_ONCE))


def _coefficients(spline: Spline, axes: tuple[int, ...]) -> NDArray[np.intp]:
    """Return the places of the coefficients of some axes among all."""
    return (3 * np.arange(spline.size)[:, None] + axes).ravel()


@dataclass(frozen=True)
class Normal:
    """Normal equations of a motion, and what noise in the object adds to them, ``(P, P)``."""

    views: Views
    state: _State
    eliminated: Eliminated
    by_noise: Array

    @property
    def residual(self) -> ComplexArray:
        """``(G, K)`` what the motion leaves of the modes, in units of their noise."""
        return self.state.residual


@dataclass(frozen=True)
class _State:
    """The object for one motion; residual and slopes are whitened."""

    amplitude: Array
    residual: ComplexArray
    slopes: ComplexArray
    cost: float


def _without_shifts(
    turns: ComplexArray, shifts: ComplexArray, covariance: Array
) -> tuple[Array, ComplexArray]:
    """Return the ``(G, 3, 2)`` share that the slopes by shift have in those by rotation, and the rest."""
    carry = np.einsum("gki,gkj->gij", turns.conj(), shifts).real @ covariance
    return carry, turns - shifts @ carry.transpose(0, 2, 1)


def _add_bent(coupling: Array, values: Array, columns: Array) -> None:
    """Add ``(g, n, C)`` columns of frames to the spline's ``(size, n, C)``, by its ``(g, size)`` values."""
    met = np.flatnonzero(values.any(axis=0))
    coupling[met] += np.tensordot(values[:, met], columns, (0, 0))


def _without_object(
    values: Array, alone: ComplexArray, coupling: Array, block: ObjectBlock
) -> tuple[Array, Array]:
    """Return the ``(P, P)`` normal matrix of bending, over S objects, and how these follow, ``(n, S P)``.

    From whitened slopes ``(G, K, 3 S)`` and their products with the waves, ``(size, n, 3 S)``.
    """
    groups, size = values.shape
    points, objects = coupling.shape[1], coupling.shape[2] // 3
    slopes = alone.reshape(groups, -1, 3)
    own = np.einsum("gki,gkj->gij", slopes.conj(), slopes).real
    flat = coupling.reshape(size, points, objects, 3).transpose(1, 2, 0, 3).reshape(points, -1)
    solution = block.solve(flat)
    every = np.arange(groups)
    followed = flat.reshape(-1, 3 * size).T @ solution.reshape(-1, 3 * size)
    return bent_blocks(values, every, every, own) - followed, solution


def _shift_covariance(shifts: ComplexArray) -> Array:
    """Return ``(G, 2, 2)`` covariances of shifts with whitened ``(G, K, 2)`` slopes, for a known object."""
    curvature = np.einsum("gki,gkj->gij", shifts.conj(), shifts).real
    curvature += 1e-12 * np.trace(curvature, axis1=1, axis2=2).max() * np.eye(2) + 1e-300 * np.eye(2)
    return np.asarray(np.linalg.inv(curvature), float)


def _informed(hessian: Array, by_noise: Array) -> Array:
    """Return M J⁻¹ for a normal matrix J and M = J less what noise adds to it."""
    share, ways = scipy.linalg.eigh(by_noise, hessian, check_finite=False)
    # ways diagonalize both: waysᵀ J ways = 1
    told = 1 - np.clip(share, 0.0, _MOST_NOISE)
    return np.asarray((hessian @ ways * told) @ ways.T)


def _pinned(hessian: Array, R: Array, values: Array) -> Array:
    """Return the Hessian with the free orientation of the object held."""
    free = np.stack(
        [np.linalg.lstsq(values, R[:, axis, :], rcond=None)[0].ravel() for axis in range(3)], axis=1
    )
    free, _ = np.linalg.qr(free)
    scale = float(np.mean(np.diag(hessian)))
    # differences of large matrices are rounded, and of a motion that is all wrong not positive
    rounded = _ROUNDING * scale * np.eye(len(hessian))
    return np.asarray(hessian + _FIXED_GAUGE * scale * free @ free.T + rounded)
