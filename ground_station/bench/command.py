"""`blimp bench`: what each step costs; one module for each of its commands."""

from __future__ import annotations

import argparse
import importlib

_COMMANDS = (
    # name, module, help, description
    (
        "localize",
        "ground_station.bench.localize",
        "association, pose, whole frames and growth with the map",
        "Measures the localizer against the preset 'thesis' and plain methods.",
    ),
    (
        "payload",
        "ground_station.bench.payload",
        "start, latency, memory and processor time a frame of the firmware",
        "Measures the payload's own program on this machine, streaming its test picture.",
    ),
    (
        "features",
        "ground_station.bench.features.command",
        "extractors on known homographies",
        "Measures all extractors: how often points are found again and matched, time.",
    ),
    (
        "map",
        "ground_station.bench.maps.command",
        "builds against COLMAP's own on the same images; many images",
        "Measures which builds are true beside COLMAP's own, or what builds of many images cost.",
    ),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the commands and their arguments."""
    commands = parser.add_subparsers(dest="bench", required=True, metavar="WHAT")
    for name, module, help_text, description in _COMMANDS:
        measured = importlib.import_module(module)
        sub = commands.add_parser(
            name,
            help=help_text,
            description=description,
            epilog=measured.EPILOG,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        measured.add_arguments(sub)
        again = "blimp experiments --quick    (its errors, in flight)"
        sub.set_defaults(bench_module=module, next=again)


def run(args: argparse.Namespace) -> int:
    """Measures, prints the tables; raises `BlimpError` for a value out of range."""
    return int(importlib.import_module(args.bench_module).run(args))
