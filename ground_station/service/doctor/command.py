"""`blimp doctor`: checks this machine for the ground station and says how to mend it."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ground_station.service.doctor.findings import Check
    from ground_station.service.settings import StationSettings

_EPILOG = """\
examples:
  blimp doctor
  sudo blimp doctor --config /etc/blimp/station.toml

The exit status is 0 when nothing hinders the service, 1 when there is a problem."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.epilog = _EPILOG
    parser.add_argument("--config", type=Path, metavar="FILE", help="TOML file (default: defaults)")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="overrides one key"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the findings here, too")


def run(args: argparse.Namespace) -> int:
    """Examines, prints a table; raises `BlimpError` only for a file it cannot write."""
    from ground_station.files import write_json
    from ground_station.service import settings
    from ground_station.service.doctor import findings
    from ground_station.service.doctor.findings import Check
    from pi_firmware.wire.errors import ConfigError

    name = str(args.config or "defaults")
    try:
        loaded = settings.load(args.config, args.set)
        first = findings.ok("settings", name)
    except ConfigError as error:
        # What does not depend on it is still worth looking at, with the defaults.
        loaded = settings.StationSettings()
        mend = f"mend {name}; the checks below are of the defaults"
        first = findings.problem("settings", str(error), mend)
    found = findings.examine([Check("settings", lambda: first), *checks(loaded)])
    colour = sys.stdout.isatty() and "NO_COLOR" not in os.environ
    print(findings.text(found, colour=colour))
    if args.json is not None:
        write_json(args.json, findings.document(found))
    return 1 if findings.count(found, findings.PROBLEM) else 0


def checks(settings: StationSettings) -> list[Check]:
    """All checks of a configuration, in the order in which they are told."""
    from ground_station.service.doctor import machine, network, running, software, world
    from ground_station.service.doctor.findings import Check
    from ground_station.service.doctor.locked import ROOT

    return [
        Check("python", software.python),
        Check("packages", lambda: software.packages(ROOT)),
        Check("gstreamer", software.video),
        Check("ports", lambda: list(network.ports(settings))),
        Check("receive buffer", network.receive_buffer),
        Check("firewall", lambda: network.firewall_rules(settings)),
        Check("discovery", lambda: network.discovery(settings)),
        Check("token", lambda: network.access(settings.http)),
        Check("certificate", lambda: world.certificate(settings)),
        Check("map", lambda: list(world.maps(settings.map, settings.localizer.preset))),
        Check("clock", machine.clock),
        Check("memory", lambda: machine.memory(settings.payloads.most)),
        Check("disk", lambda: machine.disk(settings.recording)),
        Check("service", running.unit),
        Check("payloads", lambda: running.payloads(settings)),
    ]
