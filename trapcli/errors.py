"""The errors that trap-motion raises on purpose.

Each message is one line: which file or option, what is wrong, what to do about it. The numbers are the exit
codes of the command line; nothing here knows of the command line itself.
"""


class TrapError(Exception):
    """Base class; never raised itself."""

    exit_code = 1


class ConfigError(TrapError):
    """An option or a configuration file asks for something that makes no sense."""

    exit_code = 2


class InputError(TrapError):
    """An input can't be read: missing, truncated, of an unsupported kind, or without usable frames."""

    exit_code = 3


class OutputError(TrapError):
    """An output exists already or can't be written."""

    exit_code = 5


class UntrustedError(TrapError):
    """A result says of itself that it can't be trusted, and nobody asked to use it nevertheless."""

    exit_code = 4
