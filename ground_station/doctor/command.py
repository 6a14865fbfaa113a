"""`blimp doctor`: checks this machine for the ground station and says how to fix it."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from ground_station.service import add_lan_argument, add_settings_arguments

if TYPE_CHECKING:
    from ground_station.doctor.findings import Check, Finding
    from ground_station.service.settings import StationSettings

_EPILOG = """\
examples:
  blimp doctor
  sudo blimp doctor --lan                 # as blimp serve --lan would run
  sudo blimp doctor --config /etc/blimp/station.toml

The exit status is 0 when nothing hinders the service, 1 when there is a problem."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.epilog = _EPILOG
    parser.set_defaults(next="blimp init    (which step from payload to flight is next)")
    add_settings_arguments(parser)
    add_lan_argument(parser)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the findings here, too")


def run(args: argparse.Namespace) -> int:
    """Examines, prints a table; raises `BlimpError` only for a file it cannot write."""
    from ground_station.doctor import findings
    from ground_station.doctor.findings import Check
    from ground_station.files import write_json
    from ground_station.service import lan, settings
    from pi_firmware.wire.errors import BlimpError

    name = str(args.config or "defaults")
    todo = of_machine()
    try:
        loaded = settings.load(args.config, args.set)
        if args.lan is not None:
            loaded = lan.on(loaded, args.lan)
        first = findings.ok("settings", name)
        todo += of_settings(loaded)
    except BlimpError as error:
        fix = f"fix {name}; what depends on it is not checked"
        first = findings.problem("settings", str(error), fix)
    found = findings.examine([Check("settings", lambda: first), *todo])
    colour = sys.stdout.isatty() and "NO_COLOR" not in os.environ
    print(findings.text(found, colour=colour))
    if args.json is not None:
        write_json(args.json, findings.document(found))
    if not findings.count(found, findings.PROBLEM):
        return 0
    args.next = "blimp doctor    (again, once that is fixed)"
    return 1


def of_machine() -> list[Check]:
    """The checks that need no configuration, in the order in which they are told."""
    from ground_station.doctor import ROOT, machine, network, running, software
    from ground_station.doctor.findings import Check

    return [
        Check("python", software.python),
        Check("packages", lambda: software.packages(ROOT)),
        Check("gstreamer", software.video),
        Check("receive buffer", network.receive_buffer),
        Check("clock", machine.clock),
        Check("service", running.unit),
    ]


def of_settings(settings: StationSettings) -> list[Check]:
    """The checks of what a configuration names."""
    from ground_station.doctor import machine, network, running, world
    from ground_station.doctor.findings import Check

    def ports() -> Iterator[Finding]:
        yield from network.ports(settings)
        yield running.payloads(settings)  # after them: it takes one that would be found in use

    return [
        Check("reach", lambda: network.reach(settings)),
        Check("ports", ports),
        Check("firewall", lambda: network.firewall_rules(settings)),
        Check("discovery", lambda: network.discovery(settings)),
        Check("token", lambda: network.token(settings.http)),
        Check("certificate", lambda: world.certificate(settings)),
        Check("cards", lambda: list(world.cards(settings))),
        Check("map", lambda: list(world.maps(settings.map, settings.localizer.preset))),
        Check("memory", lambda: machine.memory(settings.payloads.most)),
        Check("disk", lambda: machine.disk(settings.recording)),
    ]
