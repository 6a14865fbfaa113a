"""`blimp replay`: a recorded flight through firmware, link and localizer."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from ground_station.replay.cases import command as cases

_EPILOG = """\
examples:
  blimp replay flight.mcap --map maps/atrium --out out/replay
  blimp replay --demo --out out/demo
  blimp replay --compare out/before out/after
  blimp replay --make-case flight.mcap --map maps/atrium --truth recording --out flight.toml
  blimp replay --accept out/replay --by "$USER" --tolerance-m 0.05 --tolerance-deg 1 \\
      --out flight.golden.txt

The firmware runs as a process of its own; video crosses RTP and telemetry Zenoh, on loopback."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.epilog = _EPILOG
    parser.set_defaults(
        next="blimp replay --make-case {recording} --map {map} --out CASE.toml    (it as a test)"
    )
    parser.add_argument(
        "recording", nargs="?", type=Path, metavar="RECORDING", help="an .mcap file"
    )
    parser.add_argument("--map", type=Path, metavar="MAP", help="folder of a registered map")
    parser.add_argument(
        "--demo", action="store_true", help="map the sample building first, then fly its flight"
    )
    parser.add_argument(
        "--out", type=Path, metavar="DIR",
        help="results.json, report.html and outcome/, every frame, go here (default: out/replay)",
    )  # fmt: skip
    parser.add_argument(
        "--preset", default="default", metavar="NAME|FILE.toml",
        help="the localizer's settings: default (the default), thesis, or a file",
    )  # fmt: skip
    parser.add_argument(
        "--init", metavar="truth|none|TUM.txt",
        help="the first frame's pose: found from the map alone (none, the default), the "
        "recording's true one (truth, which the preset thesis needs and gets), or of a file",
    )  # fmt: skip
    parser.add_argument(
        "--rate-hz", type=float, metavar="R",
        help="frames captured a second (30; with the preset thesis 5)",
    )  # fmt: skip
    parser.add_argument("--start-s", type=float, default=0.0, metavar="S", help="skip this much")
    parser.add_argument(
        "--duration-s", type=float, default=0.0, metavar="S", help="stop after (0: at the end)"
    )
    parser.add_argument(
        "--min-entropy-bits", type=float, metavar="B",
        help="the payload's gate (its own default; with the preset thesis 7.0)",
    )  # fmt: skip
    parser.add_argument(
        "--stepped", action="store_true",
        help="each frame as soon as the one before is done, and the same poses in each run",
    )  # fmt: skip
    parser.add_argument("--json", type=Path, metavar="FILE", help="write results here, too")
    cases.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Flies, writes the report, prints the pilot's table; 1 when the demo misses a bound.

    Or makes, accepts or compares; 1 when the second run is worse.
    """
    from ground_station.errors import InputError

    if mode := cases.mode_of(args):
        args.next = "make hil"
        return cases.run(mode, args)
    args.out = args.out or Path("out/replay")
    if args.demo:
        if args.recording or args.map or args.stepped:
            raise InputError("--demo brings its own recording, map and pace")
        from ground_station.replay import demo

        args.next = "blimp serve --demo    (the same flight on the dashboard)"
        return demo.run(args.out, preset=args.preset, init=args.init, rate_hz=args.rate_hz)
    if args.recording is None or args.map is None:
        raise InputError("a RECORDING and --map are needed (or --demo)")
    return _replay(args)


def _replay(args: argparse.Namespace) -> int:
    from ground_station.files import write_json
    from ground_station.map import store
    from ground_station.replay import flight_report
    from ground_station.replay.replay import replay, settings_for

    settings = settings_for(
        args.preset,
        args.recording,
        rate_hz=args.rate_hz,
        init=args.init,
        gate_min_entropy_bits=args.min_entropy_bits,
        start_s=args.start_s,
        duration_s=args.duration_s,
        stepped=args.stepped,
    )
    map_ = store.load(args.map)
    args.out.mkdir(parents=True, exist_ok=True)
    began_s = time.monotonic()
    result = replay(map_, settings)
    report = flight_report.report_of(
        f"Replay of {args.recording.name}",
        result,
        map_,
        seconds=time.monotonic() - began_s,
        seeds={"localizer": result.localizer.seed},
    )
    if args.json:
        write_json(args.json, report.document)
    flight_report.publish(args.out, report)
    return 0
