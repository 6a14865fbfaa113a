"""What commands that make a map of a map have in common: where it goes, and by which settings."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ground_station.mapping.settings import MappingSettings


def add_outputs(parser: argparse.ArgumentParser) -> None:
    """Adds --out, --settings and --json."""
    parser.set_defaults(next="blimp map view {out|map} --out map.html --open")
    parser.add_argument("--out", metavar="NEWMAP", help="write here and leave MAP as it is")
    parser.add_argument("--settings", metavar="TOML", help="settings file (default: the shipped)")
    parser.add_argument("--json", metavar="FILE", help="write what was measured, too")


def checked(args: argparse.Namespace) -> MappingSettings:
    """The settings, once the outputs can be written; raises `BlimpError` in one line."""
    from ground_station.errors import MapError
    from ground_station.files import check_outputs
    from ground_station.mapping.settings import load_settings

    settings = load_settings(args.settings)
    if args.out and Path(args.out).resolve() == Path(args.map).resolve():
        raise MapError(f"--out {args.out}: is the map itself; leave --out away to replace it")
    check_outputs(args.json)
    check_outputs(args.out, are_folders=True)
    return settings
