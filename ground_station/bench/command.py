"""`blimp bench`: what each step costs; one module for each of its commands."""

from __future__ import annotations

import argparse

from ground_station.bench import localize, payload
from ground_station.bench.features import command as features
from ground_station.bench.maps import command as maps

_COMMANDS = {"localize": localize, "payload": payload, "features": features, "map": maps}
"""Each says HELP, DESCRIPTION and EPILOG and has `add_arguments` and `run`."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the commands and their arguments."""
    commands = parser.add_subparsers(dest="bench", required=True, metavar="WHAT")
    for name, room in _COMMANDS.items():
        sub = commands.add_parser(
            name,
            help=room.HELP,
            description=room.DESCRIPTION,
            epilog=room.EPILOG,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        room.add_arguments(sub)
        sub.set_defaults(next="blimp experiments --quick    (its errors, in flight)")


def run(args: argparse.Namespace) -> int:
    """Measures, prints the tables; raises `BlimpError` for a value out of range."""
    return int(_COMMANDS[args.bench].run(args))
