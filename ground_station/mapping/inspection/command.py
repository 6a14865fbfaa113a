"""`blimp map info`: its arguments and what it prints. Heavy modules are imported when it runs."""

from __future__ import annotations

import argparse

from ground_station.files import write_json
from ground_station.mapping.table import print_table

HELP = "Says what a map holds."

EXAMPLE = """\
example:
  blimp map info maps/atrium --json out/atrium.json"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of `blimp map info`."""
    parser.add_argument("map", metavar="MAP", help="folder of the map")
    parser.add_argument("--json", metavar="FILE", help="write it as JSON, too")


def run(args: argparse.Namespace) -> int:
    """Prints; raises `BlimpError` for what a person can mend."""
    from ground_station.mapping.inspection.summary import describe
    from ground_station.mapping.store import load

    document = describe(load(args.map))
    print_table(document)
    if args.json:
        write_json(args.json, document)
    return 0
