"""``trap-motion report``: a result as one page to look at."""

from __future__ import annotations

from pathlib import Path

import click

from trapcli.cli.options import PATH, Console, console_options, overwrite_option, print_path, refuse_input


@click.command()
@click.argument("result", type=PATH)
@click.argument("stack", metavar="[STACK]", required=False)
@click.option("-o", "--output", type=PATH, help="Page to write.  [default: RESULT.html]")
@click.option("--volume", type=PATH, help="What reconstruct wrote, shown turning beside the frames.")
@overwrite_option
@console_options
def command(
    result: Path,
    stack: str | None,
    output: Path | None,
    volume: Path | None,
    overwrite: bool,
    console: Console,
) -> None:
    """Write RESULT as one HTML page to look at, print and pass on.

    The page says first whether the motion can be trusted, then shows it: curves with their errors, the
    directions from which the object was seen, the misfit of each frame, parameters and provenance. With the
    STACK it also shows frames with the tracked centre and the rotation axis, and checks background and noise;
    with --volume the object turns by the motion beside them. It holds all it needs and loads nothing. The
    name of the page goes to stdout.
    """
    from trapcli.atomic import atomic_path, check_output
    from trapcli.errors import ConfigError
    from trapcli.report import html
    from trapcli.result.motion import Motion

    output = output or result.with_suffix(".html")
    if output.suffix.lower() not in (".html", ".htm"):
        raise ConfigError(f"{output}: no name of a page; end it in .html")
    refuse_input(output, result, *(Path(path) for path in (stack, volume) if path))
    check_output(output, overwrite)
    motion = Motion.load(result)
    shown = html.look_at_volume(volume, result, motion) if volume else None
    if shown and not shown.judgement:
        console.warn(f"{volume}: {result} does not say that this is the volume of its frames")
    seen = None
    if stack:
        with console.progress() as progress:
            seen = html.look_at(stack, motion, progress, shown)
        if not seen.same_files:
            console.warn(f"{stack}: is not the file that {result} was made from")
    page = html.page(motion, title=result.name, seen=seen, volume=shown)
    with atomic_path(output, overwrite) as temporary:
        temporary.write_text(page, encoding="utf-8")
    print_path(output)
