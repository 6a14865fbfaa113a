"""The `blimp` command over the rooms; heavy modules are imported only when a command runs."""

from __future__ import annotations

import argparse
import errno
import importlib
import os
import re
import shlex
import sys
from collections.abc import Sequence
from typing import Any, NoReturn

from ground_station import __version__
from pi_firmware.wire.errors import BlimpError, until_closed
from pi_firmware.wire.text import printable

_COMMANDS = (
    # name, room's command module, help
    ("simulate", "ground_station.simulator.command", "fly a simulated blimp and record it"),
    ("calibrate", "ground_station.calibration.command", "print a board, calibrate a camera by it"),
    ("map", "ground_station.commands.maps", "build, register and inspect maps"),
    ("models", "ground_station.commands.models", "bring, inspect and quantize learned features"),
    ("localize", "ground_station.localization.command", "find the camera in a map, frame by frame"),
    ("replay", "ground_station.replay.command", "stream a recording through the firmware"),
    ("record", "ground_station.service.record_command", "record payloads without the service"),
    ("command", "ground_station.stream.command", "ask a payload to do something"),
    ("serve", "ground_station.service.serve_command", "run the ground station and its dashboard"),
    ("doctor", "ground_station.doctor.command", "check this machine, and say how to fix it"),
    ("import", "ground_station.recording.import_command", "make a recording of a plain video"),
    ("export", "ground_station.recording.export_command", "a recording's poses for other programs"),
    ("evaluate", "ground_station.evaluation.command", "compare a trajectory with the truth"),
    ("experiments", "ground_station.experiments.command", "fly the thesis's experiments again"),
    ("init", "ground_station.service.init_command", "from a payload to a flight: what is next"),
    ("keys", "ground_station.keys.command", "certificates and keys of payloads and stations"),
    ("bench", "ground_station.bench.command", "measure what each step costs"),
)


_ADVICE = {
    errno.ENOENT: "{prog} --help has an example",
    errno.EADDRINUSE: "another blimp serve or record? blimp doctor says who has it",
    errno.ENOSPC: "df -h says what is full",
    errno.EACCES: "ls -ld says whose it is",
}
"""What to do next where the system's own reason ends an error."""


_PLACE = re.compile(r"\{([a-z_|]+)\}")


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, and where an example is."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.set_defaults(prog=self.prog)

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message}; {self.prog} --help has an example\n")


def parser() -> argparse.ArgumentParser:
    """The whole command line, built without importing anything heavy."""
    result = _Parser(
        prog="blimp",
        description="Localization for indoor blimps: simulate, map, localize, evaluate.",
        epilog="Example: blimp evaluate estimate.txt truth.txt --align se3",
    )
    result.add_argument("--version", action="version", version=f"blimp {__version__}")
    commands = result.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, module, help_text in _COMMANDS:
        sub = commands.add_parser(
            name,
            help=help_text,
            description=help_text[0].upper() + help_text[1:] + ".",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        importlib.import_module(module).add_arguments(sub)
        sub.set_defaults(module=module)
    return result


def next_of(args: argparse.Namespace) -> str:
    """The command to give next, as `COMMAND    (why)`: a command line's `next` with its own values.

    Each command has `next` among its parser's defaults, and its `run` may put another in place.
    `{out|map}` stands for the first of these arguments that was given; "" where none was.
    """
    lacks = False

    def value(place: re.Match[str]) -> str:
        nonlocal lacks
        given = [getattr(args, name) for name in place[1].split("|")]
        found = next((one for one in given if one not in (None, [])), None)
        lacks |= found is None
        return shlex.join(map(str, found)) if isinstance(found, list) else shlex.quote(str(found))

    filled = _PLACE.sub(value, args.next)
    return "" if lacks else filled


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command; the exit status is 0, 1 (a bound was missed) or 2 (bad input)."""
    return until_closed(lambda: _run(parser().parse_args(arguments)))


def _run(args: argparse.Namespace) -> int:
    # Threads are ours to schedule: BLAS's own would spin against them on a small machine. It reads
    # this once, when numpy is first imported.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        args.next = next_of(args)
        status = int(importlib.import_module(args.module).run(args))
        if args.next:
            print(f"next: {args.next}")
        return status
    except KeyboardInterrupt:
        print(f"blimp {args.command}: interrupted", file=sys.stderr)
        return 130
    except OSError as error:
        if error.filename is None:
            raise
        return _refused(args, f"{printable(str(error.filename), 200)}: {error.strerror}")
    except BlimpError as error:
        return _refused(args, str(error))


def _refused(args: argparse.Namespace, told: str) -> int:
    """Says why, and what to do where the system's own reason ends it."""
    for number, advice in _ADVICE.items():
        if told.endswith(os.strerror(number)):
            told += f"; {advice.format(prog=args.prog)}"
    print(f"blimp {args.command}: {told}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
