"""``trap-motion export``: a result as CSV or JSON."""

from __future__ import annotations

from pathlib import Path

import click

from trapcli.cli.options import PATH, Console, console_options, overwrite_option, print_path, refuse_input


@click.command()
@click.argument("result", type=PATH)
@click.option("--format", "kind", type=click.Choice(["csv", "json"]), default="csv", show_default=True)
@click.option(
    "-o", "--output", type=PATH, default="-", show_default=True, help="File to write; - for stdout."
)
@overwrite_option
@console_options
def command(result: Path, kind: str, output: Path, overwrite: bool, console: Console) -> None:
    """Write RESULT as one row per frame.

    CSV opens in any spreadsheet and with pandas.read_csv; unknown values are empty cells. JSON holds the
    units of all columns too; unknown values are null.
    """
    from trapcli.atomic import atomic_path
    from trapcli.result.motion import Motion
    from trapcli.result.table import csv_blocks, json_blocks

    refuse_input(output, result)
    motion = Motion.load(result)
    blocks = csv_blocks(motion) if kind == "csv" else json_blocks(motion)
    if output == Path("-"):
        for block in blocks:
            click.echo(block.encode(), nl=False)
        return
    with atomic_path(output, overwrite) as temporary, temporary.open("wb") as file:
        for block in blocks:
            file.write(block.encode())
    print_path(output)
    console.detail(f"{len(motion)} frames written")
