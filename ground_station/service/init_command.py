"""`blimp init`: how far one is on the way from a payload to a flight, and the next command."""

from __future__ import annotations

import argparse
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

from ground_station.service import add_settings_arguments

if TYPE_CHECKING:
    from ground_station.service.settings import HttpSettings
    from ground_station.service.web.models import Step

_EPILOG = """\
examples:
  blimp init
  sudo blimp init --config /etc/blimp/station.toml

It changes nothing. Where the station runs, it is asked, and tells what its page does under "Steps";
otherwise it is told by what lies in this folder."""

_WIDTH = 100


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.epilog = _EPILOG
    parser.set_defaults(next="blimp serve --lan")
    add_settings_arguments(parser)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the steps here, too")


def run(args: argparse.Namespace) -> int:
    """Prints the steps; raises a `BlimpError` with one line for settings that are none."""
    import dataclasses

    from ground_station.files import write_json
    from ground_station.service import settings
    from ground_station.service.web.guide import Guide, first_way
    from ground_station.service.web.maps import Maps
    from ground_station.service.web.recordings import Recordings

    loaded = settings.load(args.config, args.set)
    asked = _ask(loaded.http)
    if asked is not None:
        folder, steps = asked
        print(f"as the station sees it that runs in {folder}")
    else:
        recorded = Recordings(Path(loaded.recording.folder), lambda: "")
        steps = Guide(loaded, Maps(loaded.map), recorded).steps(None)
        print(f"no station runs; by what is in {Path.cwd()}")
    for number, step in enumerate(steps, 1):
        print("\n".join(_lines(number, step)))
    if args.json:
        write_json(args.json, {"steps": [dataclasses.asdict(step) for step in steps]})
    args.next = first_way(steps) or args.next
    return 0


def _lines(number: int, step: Step) -> list[str]:
    lines = [f"\n{number} {step.title}: {step.state.upper()}", f"    {step.found}"]
    if step.state != "done":
        for way in step.ways:
            lines += textwrap.wrap(f"- {way.text}", _WIDTH, initial_indent="    ")
            lines += [f"        {way.command}"] if way.command else []
    return [*lines, f"    check: {step.check}"]


def _ask(http: HttpSettings) -> tuple[str, list[Step]] | None:
    """The folder and steps of the station that runs; None where none answers as ours does."""
    from ground_station.service.asking import ask
    from ground_station.service.web.access import read_token
    from ground_station.service.web.models import Step, Way
    from pi_firmware.wire.errors import BlimpError

    try:
        document = ask(http, "/api/guide", read_token(http))
        steps = [
            Step(**{**item, "ways": [Way(**way) for way in item["ways"]]})
            for item in document["steps"]
        ]
        return str(document["folder"]), steps
    except (OSError, ValueError, KeyError, TypeError, BlimpError):
        return None
