"""`blimp map`: the commands of its rooms. Heavy modules are imported when one runs."""

from __future__ import annotations

import argparse

from ground_station.inspection import command as info
from ground_station.inspection import export_command as export
from ground_station.inspection import view_command as view
from ground_station.map_update import refining as refine
from ground_station.map_update.extension import command as extend
from ground_station.mapping.construction import command as build
from ground_station.mapping.importing import command as importing
from ground_station.mapping.registration import command as register

_COMMANDS = {
    "build": build,
    "import": importing,
    "register": register,
    "refine": refine,
    "extend": extend,
    "info": info,
    "view": view,
    "export": export,
}
"""Each says HELP and EXAMPLE and has `add_arguments` and `run`."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the commands to the parser of `blimp map`."""
    commands = parser.add_subparsers(dest="map_command", required=True, metavar="COMMAND")
    for name, room in _COMMANDS.items():
        room.add_arguments(
            commands.add_parser(
                name,
                help=room.HELP[0].lower() + room.HELP[1:].rstrip("."),
                description=room.HELP,
                epilog=room.EXAMPLE,
                formatter_class=argparse.RawDescriptionHelpFormatter,
            )
        )


def run(args: argparse.Namespace) -> int:
    """Runs the command; raises `BlimpError` for what a person can fix."""
    return int(_COMMANDS[args.map_command].run(args))
