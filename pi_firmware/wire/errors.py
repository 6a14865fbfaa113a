"""The exception family: every error a person can cause is a `BlimpError` with a one-line text."""

import contextlib
import os
import sys
from collections.abc import Callable, Iterator

from pi_firmware.wire.text import printable

_LONGEST = 2000


class BlimpError(Exception):
    """Base of all errors of the payload and of what both sides share.

    The text is one line that names the value and the limit, whatever it was made from; programs
    print it on standard error and exit with status 2, or 3 where `restart` says that only a new
    process can fix it.
    """

    restart = False

    def __init__(self, text: str = "") -> None:
        # What it names may come from a file or from the air: it cannot steer the terminal.
        super().__init__(printable(text, _LONGEST))


class ConfigError(BlimpError):
    """A key that is unknown, missing, or has a value outside its range."""


class RecordingError(BlimpError):
    """A recording that cannot be read or written."""


class StreamError(BlimpError):
    """A video stream that cannot be produced, received or decoded."""


class TelemetryError(BlimpError):
    """A telemetry session, key or message that is not as agreed."""


class SourceError(BlimpError):
    """A camera or gauge that cannot be opened, named by its URI."""


@contextlib.contextmanager
def os_errors_as(what: object, kind: type[BlimpError]) -> Iterator[None]:
    """A disk's refusal as an error of that kind, whose line begins with `what`."""
    try:
        yield
    except OSError as error:
        raise kind(f"{what}: {error.strerror or error}") from None


def until_closed(program: Callable[[], int]) -> int:
    """Runs a program's main function; its status, 0 where nobody reads on (`… | head`)."""
    try:
        try:
            return program()
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
