"""The `trap-motion` command: subcommands are loaded on use, errors become one line and an exit code."""

from __future__ import annotations

import importlib
import os
import signal
import sys
from typing import Any

import click

from trapcli.cli.options import say
from trapcli.errors import ConfigError, OutputError, TrapError

COMMANDS = ("simulate", "estimate", "compare", "plot", "report", "reconstruct", "align", "export", "info")
FAULT = 1
INTERRUPTED = 130


class LazyGroup(click.Group):
    """Import a command's module only when it is called, so that ``--help`` answers at once."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the commands in the order of a workflow."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Load ``trapcli.cli.<name>`` and return its ``command``."""
        if cmd_name not in COMMANDS:
            return None
        command = importlib.import_module(f"trapcli.cli.{cmd_name}").command
        assert isinstance(command, click.Command)
        return command


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="trapcli", prog_name="trap-motion")
def cli() -> None:
    """Recover how a trapped particle moved, from its video alone."""


def run(arguments: list[str] | None = None) -> None:
    """Entry point of ``trap-motion``: run a command, map every failure to the exit codes of the contract."""
    signal.signal(signal.SIGTERM, _terminate)
    # our matrices are small and many: threads that share one spend most of their time waiting for each other
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        code: Any = cli.main(args=arguments, prog_name="trap-motion", standalone_mode=False)
        if sys.stdout:
            sys.stdout.flush()
    except click.ClickException as error:
        _show_usage(error)
        code = ConfigError.exit_code
    except (click.Abort, KeyboardInterrupt):
        say("interrupted")
        code = INTERRUPTED
    except TrapError as error:
        say(str(error))
        code = error.exit_code
    except SystemExit:
        code = 0  # click's answer to a reader like `head`, which has what it wanted
    except OSError as error:
        # of stdout, as those of files are a TrapError
        say(f"{error.filename or 'standard output'}: can't be written ({error.strerror or error})")
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = OutputError.exit_code
    except Exception as error:
        say(f"unexpected fault ({type(error).__name__}: {error}); please report it with what -vv shows")
        code = FAULT
    sys.exit(code if isinstance(code, int) else 0)


def _show_usage(error: click.ClickException) -> None:
    if isinstance(error, getattr(click.exceptions, "NoArgsIsHelpError", ())):
        error.show()
        return
    context = getattr(error, "ctx", None)
    hint = f"; see {context.command_path} --help" if context else ""
    say(error.format_message().rstrip(".") + hint)


def _terminate(_signal: int, _frame: object) -> None:
    raise KeyboardInterrupt
