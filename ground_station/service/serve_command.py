"""`blimp serve`: the ground station as one service."""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

from ground_station.service import add_lan_argument, add_settings_arguments

_EPILOG = """\
examples:
  blimp serve --demo                      # the sample flight, played by the real firmware
  blimp serve --map maps/hall
  blimp serve --map maps/hall --lan       # for payloads on the network, with `blimp keys`
  blimp serve --lan --join 192.168.4.1    # and beside the station there: one page for all
  blimp serve --config station.toml --set http.port=8081

The dashboard is at http://127.0.0.1:8080/ then; service/station.toml names every key."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.epilog = _EPILOG
    parser.set_defaults(next="blimp init    (which step from payload to flight is next)")
    add_settings_arguments(parser)
    parser.add_argument("--map", type=Path, metavar="MAP", help="folder of a registered map")
    parser.add_argument(
        "--demo", action="store_true", help="play the sample flight, over loopback only"
    )
    add_lan_argument(parser)
    parser.add_argument(
        "--join", action="append", default=[], metavar="STATION",
        help="address of another station of the same authority, whose map is taken where none is"
        " named; each one's page shows the payloads of both",
    )  # fmt: skip
    parser.add_argument(
        "--check", action="store_true", help="check the configuration and what it names, and exit"
    )


def run(args: argparse.Namespace) -> int:
    """Serves until a signal; raises a `BlimpError` with one line when it cannot start."""
    from ground_station.errors import InputError
    from ground_station.service import lan, settings
    from ground_station.service.ending import ending
    from ground_station.service.processes import ServiceError
    from ground_station.service.serve import check, serve

    overrides = [*args.set]
    if args.map is not None:
        overrides.append(f"map.folder={args.map}")
    elif args.demo and args.config is None:
        overrides += [f"map.folder={settings.SAMPLE}", f"map.shelf={settings.SAMPLE.parent}"]
    loaded = settings.load(args.config, overrides)
    if args.lan is not None:
        if args.demo:
            raise InputError("--demo plays over loopback only; leave out --demo or --lan")
        loaded = lan.announced(loaded, args.lan)
    if args.join:
        loaded = lan.joined(loaded, args.join)
    unnamed = args.map is None and loaded.map.folder == settings.MapSettings().folder
    if loaded.fleet.join and unnamed and not args.check:
        from ground_station.service.fleet.maps import fetched

        folder = dataclasses.replace(loaded.map, folder=str(fetched(loaded)))
        loaded = dataclasses.replace(loaded, map=folder)
    if args.check:
        check(loaded)
        print("configuration is good")
        return 0
    try:
        serve(loaded, ending(None), demo=settings.SAMPLE / "flight.mcap" if args.demo else None)
    except ServiceError:  # the process that could not start has said why
        return 2
    return 0
