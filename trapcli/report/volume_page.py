"""Figure of a volume: slices, maximum projections, resolution and coverage."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

Array = NDArray[np.float64]

_STYLE: Any = {"font.size": 10, "axes.titlesize": 11, "axes.titlelocation": "left"}
_LINE, _LEVEL = "#1f4fa8", "#808080"
_LEVELS = (0.5, 0.143)
_PLANES = (("x₁", "x₂", "x₃"), ("x₁", "x₃", "x₂"), ("x₂", "x₃", "x₁"))
"""Across, down and along; axes x₃, x₂, x₁ of the volume are 0, 1, 2."""


@dataclass(frozen=True)
class Judgement:
    """What a reconstruction says of its own quality, see `trapcli.reconstruction.volume.Reconstruction`.

    Attributes
    ----------
    frequency, correlation:
        ``(S,)`` Fourier shell correlation.
    direction, times_seen, share:
        ``(D, 3)``, ``(D,)`` and the share of directions seen.
    """

    frequency: Array
    correlation: Array
    direction: Array
    times_seen: NDArray[np.integer[Any]]
    share: float


def draw_volume(
    values: NDArray[Any], voxel_size: float, unit: str, *, judgement: Judgement | None = None, title: str = ""
) -> Figure:
    """Draw the three slices through the middle above the three maximum projections.

    Parameters
    ----------
    values:
        ``(n3, n2, n1)`` volume ``[x3, x2, x1]``.
    voxel_size, unit:
        Edge of a voxel.
    judgement:
        Adds the shell correlation and the directions seen.
    """
    with matplotlib.rc_context(_STYLE):
        columns = 4 if judgement else 3
        figure = Figure(figsize=(3.4 * columns, 6.8), layout="constrained")
        FigureCanvasAgg(figure)
        grid = figure.subplots(2, columns)
        low, high = min(0.0, float(np.nanmin(values))), float(np.nanmax(values)) or 1.0
        for column, names in enumerate(_PLANES):
            along = "₃₂₁".index(names[2][1])
            middle = np.take(values, values.shape[along] // 2, axis=along)
            for axes, image, words in (
                (grid[0, column], middle, f"slice {names[2]} = 0"),
                (grid[1, column], values.max(axis=along), f"maximum along {names[2]}"),
            ):
                shown = _draw_plane(axes, image, voxel_size, unit, names)
                shown.set_clim(low, high)
                axes.set_title(words)
        figure.colorbar(shown, ax=grid[:, 2], label=f"attenuation (1/{unit})", fraction=0.08)
        if judgement:
            _draw_correlation(grid[0, 3], judgement, unit)
            _draw_sphere(grid[1, 3], judgement)
        if title:
            figure.suptitle(title, x=0.01, ha="left", fontsize=11, parse_math=False)
    return figure


def _draw_plane(axes: Axes, image: NDArray[Any], voxel_size: float, unit: str, names: tuple[str, ...]) -> Any:
    rows, columns = image.shape
    left, top = -(columns // 2) - 0.5, -(rows // 2) - 0.5
    extent = [voxel_size * edge for edge in (left, left + columns, top + rows, top)]
    axes.set_xlabel(f"{names[0]} ({unit})")
    axes.set_ylabel(f"{names[1]} ({unit})")
    return axes.imshow(image, cmap="gray", extent=(extent[0], extent[1], extent[2], extent[3]))


def _draw_correlation(axes: Axes, judgement: Judgement, unit: str) -> None:
    axes.plot(judgement.frequency, judgement.correlation, color=_LINE)
    for level in _LEVELS:
        axes.axhline(level, color=_LEVEL, lw=0.8, ls="--")
        axes.text(0, level, f"{level}", va="top", color=_LEVEL)
    axes.set_ylim(-0.1, 1.05)
    axes.set_xlabel(f"spatial frequency (1/{unit})")
    axes.set_title("half-sets: Fourier shell correlation")


def _draw_sphere(axes: Axes, judgement: Judgement) -> None:
    """Show half the sphere in Lambert's equal-area projection along x₃."""
    x1, x2, x3 = judgement.direction.T
    scale = np.sqrt(2 / (1 + np.clip(x3, 0, None)))
    seen = judgement.times_seen > 0
    axes.scatter(scale[~seen] * x1[~seen], scale[~seen] * x2[~seen], s=3, color="#d1332e", lw=0)
    axes.scatter(
        scale[seen] * x1[seen],
        scale[seen] * x2[seen],
        s=3,
        c=np.log(judgement.times_seen[seen]),
        cmap="Blues",
        vmin=-1,
        lw=0,
    )
    axes.set_aspect("equal")
    axes.invert_yaxis()  # x₂ runs downwards, as in a frame
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_xlabel("x₁, x₂ of the object; x₃ in the middle")
    axes.set_title(f"seen: {100 * judgement.share:.0f} %" + ("" if seen.all() else ", red: not seen"))
