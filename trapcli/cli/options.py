"""What several commands share: options, the configuration, and what goes to the terminal.

Nothing here imports NumPy, so that ``--help`` answers at once.
"""

from __future__ import annotations

import functools
import json
import math
import os
import shlex
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

if TYPE_CHECKING:
    from trapcli.config import C

Function = TypeVar("Function", bound=Callable[..., Any])
Progress = Callable[[str, int, int], None]
"""``progress(stage, done, total)``."""

PATH: click.Path = click.Path(path_type=Path)

json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object for scripts.")
overwrite_option = click.option("--overwrite", is_flag=True, help="Replace an output that exists.")
config_option = click.option(
    "--config",
    type=PATH,
    metavar="FILE",
    help="TOML file with options, or a result whose configuration is used again.",
)


def say(message: str) -> None:
    """Say one line on stderr."""
    click.echo(f"trap-motion: {' '.join(message.split())}", err=True)


@dataclass(frozen=True)
class Console:
    """Everything that goes to stderr: −1 is quiet, 0 normal, 1 and more verbose."""

    verbosity: int = 0

    def warn(self, message: str) -> None:
        """Say what the user should know before trusting a result; silent when quiet."""
        self.note(f"warning: {message}")

    def note(self, message: str) -> None:
        """Say one line; silent when quiet."""
        if self.verbosity >= 0:
            self.error(message)

    def error(self, message: str) -> None:
        """Say one line, also when quiet."""
        say(message)

    def detail(self, message: str) -> None:
        """Say one line when verbose."""
        if self.verbosity > 0:
            self.note(message)

    @contextmanager
    def progress(self) -> Iterator[Progress | None]:
        """Give a progress callback that draws a bar; None without a terminal or when quiet."""
        if self.verbosity < 0 or sys.stderr is None or not sys.stderr.isatty():
            yield None
            return
        from tqdm import tqdm

        with tqdm(file=sys.stderr, leave=False, dynamic_ncols=True) as bar:

            def show(stage: str, done: int, total: int) -> None:
                if bar.desc != f"{stage}: ":
                    bar.reset(total=total)
                    bar.set_description(stage)
                bar.update(done - bar.n)

            yield show


def console_options(command: Function) -> Function:
    """Add ``-q`` and ``-v`` to a command, which gets them as ``console``."""

    @click.option("-q", "--quiet", is_flag=True, help="Only errors on stderr.")
    @click.option("-v", "--verbose", count=True, help="Say more; -vv also shows where an error arose.")
    @functools.wraps(command)
    def wrapper(*args: Any, quiet: bool, verbose: int, **kwargs: Any) -> Any:
        try:
            return command(*args, console=Console(-1 if quiet else verbose), **kwargs)
        except Exception:
            if verbose > 1:
                traceback.print_exc()
            raise

    return wrapper  # type: ignore[return-value]


def preparing_options(command: Function) -> Function:
    """Add what decides how the frames of a result are prepared, see `trapcli.reconstruction.prepare`."""
    for option in reversed(
        (
            click.option(
                "--attenuation",
                is_flag=True,
                default=None,
                help="The frames are attenuation projections already.",
            ),
            click.option("--background", metavar="FILE|...", help="Another empty field than the estimate's."),
            click.option("--dark", metavar="LEVEL|FILE", help="Another pixel value without light."),
            click.option(
                "--pixel-size", type=float, metavar="P", help="Edge of a pixel in the result's unit."
            ),
            click.option("--untrusted", is_flag=True, help="Use a motion even if its verdict is against it."),
        )
    ):
        command = option(command)
    return command


def resolve_config(cls: type[C], file: Path | None, options: dict[str, Any]) -> C:
    """Fill the configuration dataclass `cls`: an option beats the file, the file beats the default.

    Parameters
    ----------
    file:
        TOML, or a result file, whose stored configuration is taken.
    options:
        Nested table as in the TOML file; None stands for an option that wasn't given.

    Raises
    ------
    ConfigError
        For an unknown key or a wrong value, naming the file or the option.
    InputError
        Where `file` is an HDF5 file but no result.
    """
    from trapcli.config import from_dict, merge

    stored = _read_config(file) if file else {}
    if file:
        from_dict(cls, stored, str(file))
    return from_dict(cls, merge(stored, _given(options)), "options")


def _read_config(file: Path) -> dict[str, Any]:
    from trapcli.config import load_toml

    if not _is_hdf5(file):
        return load_toml(file)
    import tomllib

    from trapcli.errors import ConfigError
    from trapcli.result.motion import Motion

    try:
        return tomllib.loads(Motion.load(file).provenance.get("configuration", ""))
    except (ValueError, RecursionError):
        raise ConfigError(f"{file}: the configuration stored in it can't be read") from None


def _is_hdf5(file: Path) -> bool:
    if not file.is_file():  # bytes taken from a pipe would be gone
        return False
    try:
        with file.open("rb") as stream:
            return stream.read(8) == b"\x89HDF\r\n\x1a\n"
    except OSError:
        return False


def _given(options: dict[str, Any]) -> dict[str, Any]:
    tables = ((key, _given(value) if isinstance(value, dict) else value) for key, value in options.items())
    return {key: value for key, value in tables if value is not None}


def command_line() -> str:
    """Return the command line as it would be typed in a shell."""
    return shlex.join(["trap-motion", *sys.argv[1:]])


def refuse_input(output: Path, *inputs: Path) -> None:
    """Refuse to write onto a file that is read, also under another name.

    Raises
    ------
    OutputError
        Where `output` is one of `inputs`.
    """
    from trapcli.errors import OutputError

    for path in inputs:
        if os.path.exists(output) and os.path.exists(path) and output.samefile(path):
            raise OutputError(f"{output}: is an input; choose another name")


def print_path(path: Path) -> None:
    """Print a path on stdout, byte for byte as the file system has it."""
    click.echo(os.fsencode(path))


def print_text(text: str) -> None:
    """Print text on stdout; what its encoding lacks becomes a question mark."""
    encoding = sys.stdout.encoding or "utf-8"
    click.echo(text.encode(encoding, "replace").decode(encoding))


def print_json(value: Any) -> None:
    """Print `value` as one strict JSON object on stdout; NaN and infinity become null."""
    click.echo(json.dumps(_finite(value), allow_nan=False))


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(v) for key, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
