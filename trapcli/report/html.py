"""A result as one page for a browser, which needs nothing but itself: words, figures, a sphere to turn."""

from __future__ import annotations

import base64
import dataclasses
import html
import io
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from trapcli.errors import InputError
from trapcli.report import figures, turning
from trapcli.report.checks import FrameChecks, check_frames, findings
from trapcli.report.figures import Projection
from trapcli.report.projections import choose, open_again, pixel_size
from trapcli.report.turning import Turning
from trapcli.report.volume_page import Judgement, draw_volume
from trapcli.report.words import facts, flagged, headline
from trapcli.result import provenance
from trapcli.result.motion import Motion
from trapcli.stack.frames import Frames

SHOWN = 4
"""Frames of the stack that are shown."""

_POINTS = 1500
"""Most points of the path on the sphere."""
_VECTORS = 4000
"""Longest result whose curves are drawn as vectors; those of longer ones would fill the page's 5 MB."""
_FILM = (
    "<figure><canvas id='film'></canvas><figcaption>Video, object kept in the middle</figcaption></figure>"
)
_SCRIPTS = ("turnable.js", "sphere.js", "turning.js")
_TEXTS = {
    "command_line": "command line",
    "inputs": "inputs (SHA-256)",
    "program": "program",
    "version": "version",
    "date": "date",
    "libraries": "libraries",
    "warnings": "warnings",
    "configuration": "parameters",
}


@dataclass(frozen=True)
class Volume:
    """The object that was reconstructed from the frames of a result.

    Attributes
    ----------
    values:
        ``(n, n, n)`` ``[x3, x2, x1]``.
    voxel_size, unit:
        Edge of a voxel.
    judgement:
        What the result says of it; None where that is of another volume.
    turning:
        What the page shows turning.
    """

    values: NDArray[Any]
    voxel_size: float
    unit: str
    judgement: Judgement | None
    turning: Turning


@dataclass(frozen=True)
class Seen:
    """What the stack itself shows.

    Attributes
    ----------
    raw, attenuation:
        The same frames as recorded and as attenuation; `raw` is empty where they are attenuation already.
    same_files:
        Whether the files are those of the result, by their checksums.
    notes, warnings:
        What was done to the frames, and what is doubtful about them.
    turning:
        The volume with frames beside it; None without a volume.
    """

    raw: tuple[Projection, ...]
    attenuation: tuple[Projection, ...]
    checks: FrameChecks
    same_files: bool
    notes: tuple[str, ...]
    warnings: tuple[str, ...]
    turning: Turning | None = None


def look_at(
    stack: str,
    motion: Motion,
    progress: Callable[[str, int, int], None] | None = None,
    volume: Volume | None = None,
) -> Seen:
    """Read the frames of a result again, in the way that its own configuration tells.

    Parameters
    ----------
    volume:
        The object that some of the frames shall be shown beside.

    Raises
    ------
    InputError
        Where the stack can't be read, or has other frames than the result.
    """
    from trapcli.preprocess.attenuation import to_attenuation

    frames, config = open_again(stack, motion)
    try:
        attenuation = to_attenuation(frames, config.preprocess, roi=config.input.roi)
    except InputError as error:
        if str(error).startswith((f"{config.preprocess.background}:", f"{config.preprocess.dark}:")):
            hint = "the result was made with this file; call this in the folder where the estimate was called"
            raise InputError(f"{error}; {hint}") from None
        raise
    chosen = choose(motion, SHOWN)
    checks = check_frames(attenuation, chosen, progress)
    size = pixel_size(frames, motion)

    def shown(images: Iterable[NDArray[Any]]) -> tuple[Projection, ...]:
        numbers = motion.frame[chosen].tolist()
        return tuple(Projection(n, np.array(image), size) for n, image in zip(numbers, images, strict=False))

    raw = [] if config.preprocess.attenuation else frames.pick(np.array(chosen))
    info = attenuation.info
    return Seen(
        raw=shown(raw),
        attenuation=shown(checks.images),
        checks=checks,
        same_files=_same_files(frames, motion),
        notes=info.notes,
        warnings=info.warnings,
        turning=turning.with_film(volume.turning, attenuation, motion, size) if volume and size else None,
    )


def look_at_volume(path: Path, result: Path, motion: Motion) -> Volume:
    """Read a volume that was reconstructed from the frames of a result.

    Raises
    ------
    InputError
        Where it can't be read, or can't be turned by this motion.
    """
    from trapcli.reconstruction.volume_files import read_judgement, read_volume

    values, voxel_size, unit = read_volume(path)
    try:
        turned = turning.prepare(values, voxel_size, unit, motion)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return Volume(values, voxel_size, unit, read_judgement(result, path), turned)


def page(motion: Motion, *, title: str, seen: Seen | None = None, volume: Volume | None = None) -> str:
    """Return the report on a result as HTML, at most 5 MB that load nothing else.

    Parameters
    ----------
    title:
        Name of the result.
    seen:
        What `look_at` found in its stack; without it there are no frames and no checks.
    volume:
        The object, shown turning by the motion.
    """
    verdict = headline(motion)
    curves = figures.draw(dataclasses.replace(motion, verdict=""))  # the page says it already
    return _part("page.html").substitute(
        title=_text(title),
        style=_source("page.css"),
        script="\n".join(_source(name) for name in _SCRIPTS[: 3 if volume else 2]),
        level=verdict.level,
        verdict=_text(verdict.title),
        reason=_text(verdict.text),
        doubts=_doubts(motion, seen),
        facts=_table(facts(motion)),
        frames=_frames(motion, seen),
        curves=_image(curves, len(motion), "T, φ, ω₃ and α over time with 1-σ bands"),
        path=_json(path_on_sphere(motion)),
        object=_object(motion, seen, volume),
        quality=_image(figures.draw_quality(motion), len(motion), "residual and flags of each frame"),
        flags=_flags(motion),
        checks=_checks(motion, seen),
        provenance=_provenance(motion),
    )


def path_on_sphere(motion: Motion) -> dict[str, Any]:
    """Return γ(t) = R(t) e₃, the viewing direction in coordinates of the object, for the script of the page.

    Object coordinates are those of the laboratory at the first frame; null where R isn't known.
    """
    rows = np.unique(np.linspace(0, len(motion) - 1, _POINTS).round().astype(int))
    points = [
        [round(float(x), 4) for x in gamma] if np.isfinite(gamma).all() else None
        for gamma in motion.R[rows, :, 2]
    ]
    return {
        "points": points,
        "time": [float(f"{time:.6g}") for time in motion.time[rows]],
        "frame": motion.frame[rows].tolist(),
        "valid": [int(valid > 0) for valid in motion.valid[rows]],
        "unit": motion.time_unit,
    }


def _same_files(frames: Frames, motion: Motion) -> bool:
    """Compare checksums: names may have changed."""
    stored = {line.lstrip("\\").split("  ")[0] for line in motion.provenance.get("inputs", "").splitlines()}
    return all(provenance.checksum_line(file, "-").split("  ")[0] in stored for file in frames.info.files)


# parts of the page


def _doubts(motion: Motion, seen: Seen | None) -> str:
    doubts = motion.provenance.get("warnings", "").splitlines()
    if seen:
        doubts += [warning for warning in seen.warnings if " ".join(warning.split()) not in doubts]
        if not seen.same_files:
            doubts.append("the stack given for this report is not the file that was estimated")
    return (
        f"<ul class='doubts'>{''.join(f'<li>{_text(doubt)}</li>' for doubt in doubts)}</ul>" if doubts else ""
    )


def _frames(motion: Motion, seen: Seen | None) -> str:
    if not seen:
        return "<p class='missing'>No frames: give the stack after the result to see some.</p>"
    rows = [row for row in (seen.raw, seen.attenuation) if row]
    drawn = _image(figures.draw_frames(motion, *rows), _VECTORS + 1, "frames with centre and axis")
    above = "Above as recorded, below as attenuation. " if len(rows) > 1 else ""
    return (
        f"{drawn}<p>{above}Cross: tracked centre of the object, with its path. Orange: rotation axis as it "
        "appears in the image; it reaches the dotted circle where it lies in the image plane, and shrinks to "
        "a point where it is the line of sight.</p>"
    )


def _object(motion: Motion, seen: Seen | None, volume: Volume | None) -> str:
    if not volume:
        return "<p class='missing'>No volume: give what reconstruct wrote with --volume to see it turn.</p>"
    shown = (seen.turning if seen else None) or volume.turning
    at = motion.frame[shown.positions]
    words = f"Frames {at[0]} to {at[-1]}"
    if len(at) > 1 and (step := int(np.median(np.diff(at)))) > 1:
        words += f" in steps of {step}"
    film = _FILM if shown.film is not None else ""
    if film:
        words += (
            ". Where motion and volume are right, the projection looks like the video without its noise; "
            "both have one grey scale"
        )
    words += (
        f". Each picture is {len(shown.values) * shown.step:.3g} {shown.unit} wide. Orange: rotation axis. "
        "A higher level shows what lies inside, in a glassy hull; a double click, the view of the camera."
    )
    drawn = draw_volume(volume.values, volume.voxel_size, volume.unit, judgement=volume.judgement)
    return _part("turning.html").substitute(
        film=film,
        words=words,
        scene=_json(turning.to_json(shown, motion)),
        samples=turning.packed(shown),
        figure=_image(drawn, _VECTORS + 1, "slices and maximum projections of the volume"),
    )


def _flags(motion: Motion) -> str:
    rows = [(name, f"{count} frames: {where}") for name, count, where in flagged(motion)]
    return _table(rows) if rows else "<p>No frame is flagged.</p>"


def _checks(motion: Motion, seen: Seen | None) -> str:
    if not seen:
        return "<p class='missing'>Not checked: give the stack after the result.</p>"
    rows = "".join(
        f"<tr class='{'good' if finding.good else 'fair'}'><th>{_text(finding.name)}</th>"
        f"<td>{'as it should be' if finding.good else 'look at this'}</td><td>{_text(finding.text)}</td></tr>"
        for finding in findings(seen.checks)
    )
    notes = "".join(f"<p>{_text(note)}</p>" for note in seen.notes)
    drawn = figures.draw_checks(motion, seen.checks)
    return f"<table>{rows}</table>{_image(drawn, len(motion), 'checks of each frame')}{notes}"


def _provenance(motion: Motion) -> str:
    texts = motion.provenance
    names = [name for name in _TEXTS if texts.get(name)] + sorted(set(texts) - set(_TEXTS))
    rows = "".join(
        f"<tr><th>{_text(_TEXTS.get(name, name))}</th><td><pre>{_text(texts[name])}</pre></td></tr>"
        for name in names
    )
    return f"<table>{rows}</table>"


def _table(rows: Sequence[tuple[str, str]]) -> str:
    cells = "".join(f"<tr><th>{_text(name)}</th><td>{_text(value)}</td></tr>" for name, value in rows)
    return f"<table>{cells}</table>"


def _image(figure: Figure, length: int, words: str) -> str:
    """Embed a figure, as vectors where the result is short enough."""
    suffix, kind = (".svg", "svg+xml") if length <= _VECTORS else (".png", "png")
    data = io.BytesIO()
    figures.save(figure, data, suffix)
    encoded = base64.b64encode(data.getvalue()).decode()
    return f'<img alt="{_text(words)}" src="data:image/{kind};base64,{encoded}">'


def _text(text: str) -> str:
    """Escape a text; what no encoding holds, as in names of files, is shown as an escape."""
    return html.escape(text.encode("utf-8", "backslashreplace").decode())


def _json(value: Any) -> str:
    """Return JSON that can't end the script element it stands in."""
    return json.dumps(value, separators=(",", ":")).replace("<", "\\u003c")


def _part(name: str) -> Template:
    return Template(_source(name))


def _source(name: str) -> str:
    return (files("trapcli.report") / name).read_text(encoding="utf-8")
