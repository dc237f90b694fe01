"""The figures of the paper's section Numerics for one result (Elbau et al. 2020, Inverse Problems 36).

Projections with the tracked centre and the rotation axis (``fig:projections``), translation
(``fgRecCenter``), Φ (``fgResidual``), φ and ω₃ (``fgRecAngle``), α (``fgRecAlpha``) and, with a truth, the
errors (``fgRecErrors``); for the page of `trapcli.report.html` also residual, flags and checks.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.gridspec import GridSpec, SubplotSpec
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch
from numpy.typing import NDArray

from trapcli.report.checks import FrameChecks
from trapcli.result.comparison import Matched, match, wrap
from trapcli.result.motion import FLAG_MEANINGS, Array, Flag, Motion

FORMATS = (".png", ".pdf", ".svg")

_RESULT, _RESULT_2 = "#1f4fa8", "#3aa0c9"
_TRUTH = "#d1332e"
_AXIS = "#e0831a"
_AXIS_LENGTH = 0.35
"""Of a rotation axis that lies in the image plane, to either side, as a share of the shorter edge."""
_ERRORS = {"phi": ("φ", "x", _RESULT), "omega_3": ("ω₃", "^", "#e0831a"), "alpha": ("α", "s", "#2a8c4a")}
_BAND = 0.22
_INVALID, _SHADE = "#b8b8b8", 0.35
_MARKS = 80
"""Most crosses on a curve; the line below them shows every frame."""
_POINTS = 2000
"""Most error marks of a kind; beyond, every second, third, … frame is shown."""
_SERIES = (
    "T",
    "T_errors",
    "center",
    "phi",
    "phi_errors",
    "omega_3",
    "omega_3_errors",
    "alpha",
    "alpha_errors",
)
_HUGE = 1e100
_STYLE: Any = {
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.7,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "pdf.fonttype": 42,
    "svg.hashsalt": "trap-motion",
}

Panel = Callable[[Axes], None]


@dataclass(frozen=True)
class Projection:
    """One frame of the stack.

    Attributes
    ----------
    frame:
        Its index in the input.
    image:
        ``(H, W)`` pixels.
    pixel_size:
        Edge of a pixel in the length unit of the result; None where it isn't known: no centre is drawn then.
    """

    frame: int
    image: NDArray[Any]
    pixel_size: float | None


def draw(
    motion: Motion,
    *,
    truth: Motion | None = None,
    projections: Sequence[Projection] = (),
    steps: Sequence[int] = (),
    title: str = "",
) -> Figure:
    """Draw all figures of a result on one page.

    Parameters
    ----------
    motion:
        The result: blue crosses, 1-σ bands where errors are known, grey where frames are not valid.
    truth:
        The exact motion: red curves, brought to the units and the mirror solution of the result.
    projections:
        Frames of the stack, shown with the tracked centre and its path.
    steps:
        Frames whose Φ is shown, as far as the result has it; default: the first one it has.

    Raises
    ------
    InputError
        Where result and truth have no frame in common.
    """
    motion = _drawable(motion)
    matched = match(motion, _drawable(truth)) if truth else None
    exact = _same_turn(matched) if matched else None
    panels = _panels(motion, exact, matched, steps)
    with matplotlib.rc_context(_STYLE):
        rows = -(-len(panels) // 2)
        extra = 1 if projections else 0
        figure = Figure(
            figsize=(11, 2.9 * (rows + 1.25 * extra) + 1.1),
            layout=ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.1),
        )
        FigureCanvasAgg(figure)
        ratios = [1.25] * extra + [1.0] * rows
        grid = GridSpec(rows + extra, 2, figure=figure, height_ratios=ratios)
        if projections:
            _draw_projections(figure, grid[0, :], projections, motion, exact)
        for i, panel in enumerate(panels):
            alone = i == len(panels) - 1 and i % 2 == 0
            panel(figure.add_subplot(grid[extra + i // 2, slice(None) if alone else i % 2]))
        _draw_heading(figure, motion, title)
        _draw_legend(figure, motion, exact)
    return figure


def draw_frames(motion: Motion, *rows: Sequence[Projection]) -> Figure:
    """Draw rows of frames, each with one grey scale, the tracked centre and the rotation axis.

    The axis is a line through the centre, as long as a rod along it appears in the image: it reaches the
    dotted circle where it lies in the image plane, and is a point where it is the optical axis.
    """
    motion = _drawable(motion)
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(11, 3.1 * len(rows)), layout=ConstrainedLayoutEngine(w_pad=0.08, h_pad=0.08))
        FigureCanvasAgg(figure)
        grid = GridSpec(len(rows), 1, figure=figure)
        for i, projections in enumerate(rows):
            _draw_projections(figure, grid[i], projections, motion, None)
    return figure


def draw_quality(motion: Motion) -> Figure:
    """Draw the residual of each frame, and below it a row of marks for every flag that occurs."""
    present = [(flag, words) for flag, words in FLAG_MEANINGS.items() if (motion.flags & int(flag)).any()]
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(11, 3.0 + 0.3 * len(present)), layout=ConstrainedLayoutEngine())
        FigureCanvasAgg(figure)
        ratios = [3.0, 0.1 + 0.3 * len(present)] if present else [1.0]
        grid = GridSpec(len(ratios), 1, figure=figure, height_ratios=ratios)
        axes = figure.add_subplot(grid[0])
        _shade_invalid(axes, motion)
        residual = np.where(np.abs(motion.residual) < _HUGE, motion.residual, np.nan)
        many = len(motion) > _POINTS
        axes.plot(motion.time, residual, "," if many else ".", color=_RESULT, ms=4, rasterized=many)
        marked = (motion.flags > 0) | (motion.valid == 0)
        axes.plot(motion.time[marked], residual[marked], "o", color=_TRUTH, ms=5, mfc="none", rasterized=many)
        axes.set_title("residual: relative misfit of each frame, flagged frames circled")
        _finish(axes, motion, "", residual, None)
        if present:
            _draw_flags(figure.add_subplot(grid[1], sharex=axes), motion, present)
    return figure


def draw_checks(motion: Motion, checks: FrameChecks) -> Figure:
    """Draw total attenuation, border and noise of each frame, with what the noise alone would give."""
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(11, 2.9), layout=ConstrainedLayoutEngine(w_pad=0.08))
        FigureCanvasAgg(figure)
        grid = GridSpec(1, 3, figure=figure)
        for i, (title, values, ideal, noise) in enumerate(
            (
                ("total attenuation", checks.mass, 1.0, checks.mass_noise),
                ("border, of the peak", checks.border, 0.0, checks.border_noise),
                ("pixel noise, of the peak", checks.noise, None, 0.0),
            )
        ):
            axes = figure.add_subplot(grid[i])
            if ideal is not None:
                axes.axhspan(ideal - noise, ideal + noise, color=_INVALID, alpha=_SHADE, lw=0)
                axes.axhline(ideal, color=_INVALID, lw=1)
            axes.plot(motion.time, values, "-", color=_RESULT, lw=0.8, rasterized=len(motion) > _POINTS)
            axes.set_title(title)
            axes.set_xlabel(_time_label(motion))
            if ideal is None:
                axes.set_ylim(bottom=0)
            _limit_time(axes, motion)
    return figure


def save(figure: Figure, path: Path | IO[bytes], suffix: str) -> None:
    """Write a figure as ``.png``, ``.pdf`` or ``.svg``, without a date: equal figures are equal files."""
    dates: dict[str, Any] = {".pdf": {"CreationDate": None}, ".svg": {"Date": None}, ".png": {}}
    with matplotlib.rc_context(_STYLE):
        figure.savefig(path, format=suffix[1:], dpi=150, metadata=dates[suffix])


def _panels(
    shown: Motion, exact: Motion | None, matched: Matched | None, steps: Sequence[int]
) -> list[Panel]:
    rate = f"rad/{shown.time_unit}"
    panels: list[Panel] = [partial(_draw_translation, shown=shown, exact=exact)]
    if shown.landscape is not None and (shown.landscape.values > 0).any():
        panels.append(partial(_draw_landscape, shown=shown, exact=exact, steps=steps))
    for name, symbol, unit, words in (
        ("phi", "φ", "rad", "direction of ω in the image plane"),
        ("omega_3", "ω₃", rate, "rate about the optical axis"),
        ("alpha", "α", rate, "rate about the axis in the image plane"),
    ):
        panels.append(
            partial(_draw_series, shown=shown, exact=exact, name=name, title=f"{symbol}: {words}", unit=unit)
        )
    if matched:
        panels.append(partial(_draw_errors, matched=matched))
    return panels


def _drawable(motion: Motion) -> Motion:
    """Take values that only a damaged file can hold, and that overflow when drawn, for unknown."""

    def known(values: Any) -> Any:
        return np.where(np.abs(values) < _HUGE, values, np.nan)

    landscape = motion.landscape
    if landscape is not None:
        landscape = dataclasses.replace(landscape, phi=known(landscape.phi), values=known(landscape.values))
    series = {name: known(getattr(motion, name)) for name in _SERIES}
    return dataclasses.replace(motion, landscape=landscape, **series)


def _same_turn(matched: Matched) -> Motion:
    """Shift the exact φ by the whole turns that bring it closest to the result's."""
    difference = matched.result.phi - matched.truth.phi
    known = difference[matched.usable & np.isfinite(difference)]
    turns = np.round(np.median(known) / (2 * np.pi)) if len(known) else 0.0
    return dataclasses.replace(matched.truth, phi=matched.truth.phi + 2 * np.pi * turns)


def _draw_translation(axes: Axes, shown: Motion, exact: Motion | None) -> None:
    _shade_invalid(axes, shown)
    for i, (color, marker, style) in enumerate(((_RESULT, "x", "-"), (_RESULT_2, "+", "--"))):
        if exact:
            axes.plot(exact.time, exact.T[:, i], style, color=_TRUTH, lw=1.2, zorder=5)
        _draw_measured(axes, shown, shown.T[:, i], shown.T_errors[:, i], color, marker, f"T{'₁₂'[i]}")
    axes.set_title("T: translation in the image plane")
    axes.legend(loc="best", ncols=2, handletextpad=0.3)
    _finish(axes, shown, shown.length_unit, shown.T, exact.T if exact else None)


def _draw_series(axes: Axes, shown: Motion, exact: Motion | None, name: str, title: str, unit: str) -> None:
    _shade_invalid(axes, shown)
    values = getattr(shown, name)
    true = getattr(exact, name) if exact else None
    if exact and true is not None:
        axes.plot(exact.time, true, "-", color=_TRUTH, lw=1.2, zorder=5)
    _draw_measured(axes, shown, values, getattr(shown, f"{name}_errors"), _RESULT, "x", name)
    axes.set_title(title)
    _finish(axes, shown, unit, values, true)


def _draw_measured(
    axes: Axes, shown: Motion, values: Array, errors: Array, color: str, marker: str, label: str
) -> None:
    every = -(-len(values) // _MARKS)
    axes.fill_between(shown.time, values - errors, values + errors, color=color, alpha=_BAND, lw=0, zorder=1)
    axes.plot(shown.time, values, "-", color=color, lw=0.6, alpha=0.6, zorder=3)
    axes.plot(
        shown.time, values, marker, color=color, ms=4.5, mew=1.1, markevery=every, zorder=4, label=label
    )


def _draw_errors(axes: Axes, matched: Matched) -> None:
    shown, exact = matched.result, matched.truth
    every = -(-len(shown) // _POINTS)
    positive = False
    for name, (symbol, marker, color) in _ERRORS.items():
        difference = getattr(shown, name) - getattr(exact, name)
        size = np.abs(wrap(difference) if name == "phi" else difference)
        size = np.where(matched.usable & (size > 0), size, np.nan)
        positive = positive or bool(np.isfinite(size).any())
        axes.plot(
            shown.time[::every],
            size[::every],
            marker,
            color=color,
            ms=3.5,
            mew=0.8,
            mfc="none",
            label=f"{symbol} ({'rad' if name == 'phi' else 'rad/' + shown.time_unit})",
            rasterized=len(shown) > _POINTS // 2,
        )
    if positive:
        axes.set_yscale("log")
    axes.set_title("absolute errors")
    axes.legend(loc="best", ncols=3, handletextpad=0.1, columnspacing=1.0)
    axes.set_xlabel(_time_label(shown))
    _limit_time(axes, shown)


def _draw_landscape(axes: Axes, shown: Motion, exact: Motion | None, steps: Sequence[int]) -> None:
    landscape = shown.landscape
    assert landscape is not None
    # by default far from the ends, where time derivatives are best
    rows = [row for row, frame in enumerate(landscape.frame) if frame in steps] or [len(landscape.frame) // 2]
    shades = matplotlib.colormaps["Blues"](np.linspace(0.95, 0.45, len(rows)))
    for row, shade in zip(rows, shades, strict=True):
        frame = int(landscape.frame[row])
        axes.plot(
            landscape.phi,
            np.maximum(landscape.values[row], 1e-300),
            color=shade,
            lw=1.3,
            label=f"frame {frame}",
        )
        for motion, color, style in ((shown, _RESULT, ":"), (exact, _TRUTH, "--")):
            phi = motion.phi[motion.frame == frame] if motion else np.empty(0)
            for angle in phi[np.isfinite(phi)]:
                axes.axvline(angle % np.pi, lw=1.2, color=color, ls=style)
    axes.set_yscale("log")
    axes.set_xlim(0, np.pi)
    axes.set_xticks(np.pi * np.arange(5) / 4, ["0", "π/4", "π/2", "3π/4", "π"])
    axes.set_xlabel("φ (rad)")
    axes.set_title("Φ: misfit of the first-order equation")
    axes.legend(loc="lower right")


def _draw_projections(
    figure: Figure, place: SubplotSpec, projections: Sequence[Projection], shown: Motion, exact: Motion | None
) -> None:
    inner = place.subgridspec(1, len(projections))
    known = np.concatenate([p.image[np.isfinite(p.image)] for p in projections])
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    for i, projection in enumerate(projections):
        axes = figure.add_subplot(inner[i])
        height, width = projection.image.shape
        size = projection.pixel_size or 1.0
        left, top = -(width // 2) - 0.5, -(height // 2) - 0.5
        extent = (size * left, size * (left + width), size * (top + height), size * top)
        axes.imshow(
            projection.image, cmap="gray", vmin=low, vmax=high, extent=extent, interpolation="nearest"
        )
        axes.grid(False)
        axes.spines[["top", "right"]].set_visible(True)
        axes.set_xlabel(f"x₁ ({shown.length_unit if projection.pixel_size else 'pixel'})")
        if i == 0:
            axes.set_ylabel(f"x₂ ({shown.length_unit if projection.pixel_size else 'pixel'})")
        at = np.flatnonzero(shown.frame == projection.frame)
        if len(at):
            axes.set_title(_moment(shown, int(at[0])))
        if len(at) and projection.pixel_size:
            _draw_axis(axes, shown, int(at[0]), _AXIS_LENGTH * size * min(height, width))
            _draw_center(axes, shown, exact, int(at[0]))
        axes.set_xlim(extent[:2])
        axes.set_ylim(extent[2:])


def _draw_center(axes: Axes, shown: Motion, exact: Motion | None, at: int) -> None:
    """Mark the tracked centre and the path to it."""
    axes.plot(*shown.center[: at + 1].T, "-", color=_RESULT_2, lw=1.0)
    axes.plot(*shown.center[at], "x", color=_RESULT_2, ms=8, mew=2)
    if exact:
        true = exact.center[exact.frame == shown.frame[at]]
        axes.plot(*true.T, "o", color=_TRUTH, ms=11, mew=1.2, mfc="none")


def _draw_axis(axes: Axes, shown: Motion, at: int, length: float) -> None:
    """Draw the rotation axis as a rod of this half length appears in the image."""
    phi, in_plane = shown.phi[at], shown.alpha[at] / np.hypot(shown.alpha[at], shown.omega_3[at] or 1e-300)
    if not np.isfinite(phi + in_plane):
        return
    end = length * in_plane * np.array([np.cos(phi), np.sin(phi)])
    axes.plot(*np.stack([shown.center[at] - end, shown.center[at] + end]).T, "-", color=_AXIS, lw=1.6)
    axes.add_patch(Circle(shown.center[at], length, fill=False, color=_AXIS, lw=0.8, ls=":"))


def _draw_flags(axes: Axes, motion: Motion, present: Sequence[tuple[Flag, str]]) -> None:
    for row, (flag, _) in enumerate(present):
        at = motion.time[(motion.flags & int(flag)) > 0]
        axes.plot(at, np.full(len(at), row), "|", color=_TRUTH, ms=9, rasterized=len(at) > _POINTS)
    axes.set_yticks(range(len(present)), [words.split(":")[0] for _, words in present])
    axes.set_ylim(len(present) - 0.5, -0.5)
    axes.set_xlabel(_time_label(motion))


def _draw_heading(figure: Figure, motion: Motion, title: str) -> None:
    lines = [title.encode("utf-8", "backslashreplace").decode()] if title else []
    if motion.verdict:
        lines.append(motion.verdict)
    text = figure.suptitle(
        "\n".join(" ".join(line.split()) for line in lines),
        x=0.01,
        ha="left",
        fontsize=11,
        wrap=True,
        parse_math=False,
    )
    if not motion.identifiable:
        text.set_color(_TRUTH)


def _draw_legend(figure: Figure, shown: Motion, exact: Motion | None) -> None:
    entries: list[Line2D | Patch] = [
        Line2D([], [], color=_RESULT, marker="x", lw=0.6, ms=5, label="reconstructed")
    ]
    if any(np.isfinite(e).any() for e in (shown.phi_errors, shown.T_errors, shown.alpha_errors)):
        entries.append(Patch(color=_RESULT, alpha=_BAND, lw=0, label="1 σ"))
    if exact:
        entries.append(Line2D([], [], color=_TRUTH, lw=1.4, label="exact"))
    if (shown.valid == 0).any():
        entries.append(Patch(color=_INVALID, alpha=_SHADE, lw=0, label="not valid"))
    figure.legend(handles=entries, loc="outside lower center", ncols=len(entries))


def _shade_invalid(axes: Axes, shown: Motion) -> None:
    """Shade runs of frames that are not valid, half a frame beyond each end."""
    half = np.median(np.diff(shown.time)) / 2 if len(shown) > 1 else 0.5
    edges = np.flatnonzero(np.diff(np.concatenate([[0], shown.valid == 0, [0]]).astype(int)))
    for start, stop in edges.reshape(-1, 2):
        axes.axvspan(
            shown.time[start] - half,
            shown.time[stop - 1] + half,
            color=_INVALID,
            alpha=_SHADE,
            lw=0,
            zorder=0,
        )


def _finish(axes: Axes, shown: Motion, unit: str, values: Array, true: Array | None) -> None:
    """Label the axes; show all trusted and true values, and the others but for outliers."""
    known = values[np.isfinite(values)]
    if len(known):
        # Tukey's fences
        first, third = np.quantile(known, [0.25, 0.75])
        known = known[np.abs(known - (first + third) / 2) <= 2 * (third - first)]
    seen = np.concatenate(
        [values[shown.valid > 0].ravel(), known, np.empty(0) if true is None else true.ravel()]
    )
    seen = seen[np.isfinite(seen)]
    if len(seen):
        low, high = float(seen.min()), float(seen.max())
        margin = max(0.1 * (high - low), 1e-3 * max(abs(low), abs(high))) or 1.0
        axes.set_ylim(low - margin, high + margin)
    else:
        axes.text(0.5, 0.5, "not known", transform=axes.transAxes, ha="center", color="#606060")
    axes.set_xlabel(_time_label(shown))
    axes.set_ylabel(unit)
    _limit_time(axes, shown)


def _limit_time(axes: Axes, shown: Motion) -> None:
    margin = 0.01 * np.ptp(shown.time) or 1.0
    axes.set_xlim(shown.time.min() - margin, shown.time.max() + margin)


def _time_label(shown: Motion) -> str:
    return "frame" if shown.time_unit == "frame" else f"t ({shown.time_unit})"


def _moment(shown: Motion, at: int) -> str:
    frame = f"frame {shown.frame[at]}"
    return frame if shown.time_unit == "frame" else f"t = {shown.time[at]:.4g} {shown.time_unit} ({frame})"
