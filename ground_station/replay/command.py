"""`blimp replay`: a recorded flight through firmware, link and localizer."""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ground_station.errors import InputError, check_options
from pi_firmware.wire.text import printable

if TYPE_CHECKING:
    from ground_station.replay.cases.compare import Allowed, Comparison, Line

_EPILOG = """\
examples:
  blimp replay flight.mcap --map maps/atrium --out out/replay
  blimp replay --demo --out out/demo
  blimp replay --compare out/before out/after
  blimp replay --make-case flight.mcap --map maps/atrium --truth recording --out flight.toml
  blimp replay --accept out/replay --by "$USER" --tolerance-m 0.05 --tolerance-deg 1 \\
      --out flight.golden.txt

The firmware runs as a process of its own; video crosses RTP and telemetry Zenoh, on loopback."""
_OUT = {"make_case": None, "accept": None, "compare": Path("out/compare.html")}
"""Each mode's name in the arguments, and where its result goes by default."""
_OF = {
    "make_case": ("truth", "payload_id", "from_outcome", "force"),
    "accept": ("by", "tolerance_m", "tolerance_deg", "missing_max", "force"),
    "compare": ("fail_over_m", "fail_over_deg", "fail_over_max_m", "fail_over_share",
                "fail_over_ms", "identical", "json"),
}  # fmt: skip
_FLOWN = ("map", "init", "rate_hz", "start_s", "duration_s", "min_entropy_bits", "stepped")
"""What says how a recording is flown: a case takes it over, the other two have no use for it."""
_SHOWN = 14
"""Lines of a comparison on the terminal; all are on the page."""


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
    _add_modes(parser)


def _add_modes(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments of the three modes."""
    make = parser.add_argument_group("make a replay test out of a recording")
    make.add_argument(
        "--make-case", type=Path, metavar="RECORDING",
        help="write --out CASE.toml, which make hil flies in --map",
    )  # fmt: skip
    make.add_argument(
        "--truth", metavar="recording[:TOPIC]|golden|TUM.txt",
        help="what poses are held against: those in the recording (/truth/pose), an accepted run,"
        " a survey (default: nothing)",
    )  # fmt: skip
    make.add_argument(
        "--payload-id", metavar="NAME", help="whose flight, of a recording of several"
    )
    make.add_argument(
        "--from", dest="from_outcome", type=Path, metavar="OUTCOME",
        help="propose bounds: what this run measured, and a margin",
    )  # fmt: skip
    make.add_argument("--force", action="store_true", help="overwrite --out")
    accept = parser.add_argument_group("accept a run as the truth of later ones")
    accept.add_argument(
        "--accept", type=Path, metavar="OUTCOME",
        help="a folder that replay or make hil wrote; its poses go to --out FILE",
    )  # fmt: skip
    accept.add_argument("--by", metavar="NAME", help="who accepts it")
    accept.add_argument(
        "--tolerance-m", type=float, metavar="M", help="farthest a later pose may be"
    )
    accept.add_argument("--tolerance-deg", type=float, metavar="DEG", help="the same, turned")
    accept.add_argument(
        "--missing-max", type=float, metavar="SHARE",
        help="accepted poses that a later run may be without (default: 0.05)",
    )  # fmt: skip
    compare = parser.add_argument_group("compare run B with run A; status 1 when B is worse")
    compare.add_argument(
        "--compare", type=Path, nargs=2, metavar=("A", "B"),
        help="two such folders; the page goes to --out (default: out/compare.html)",
    )  # fmt: skip
    for name, unit, default, what in (
        ("m", "M", "0.02", "position's RMSE"),
        ("deg", "DEG", "0.2", "rotation's RMSE"),
        ("max-m", "M", "0.1", "worst TRACKING pose's error"),
        ("share", "S", "0.02", "coverage, TRACKING's share or loss"),
        ("ms", "MS", "any", "median latency"),
    ):
        compare.add_argument(
            f"--fail-over-{name}", type=float, metavar=unit,
            help=f"B's {what} may be worse by this (default: {default})",
        )  # fmt: skip
    compare.add_argument("--identical", action="store_true", help="any difference in a pose fails")


def run(args: argparse.Namespace) -> int:
    """Flies, writes the report, prints the pilot's table; 1 when the demo misses a bound.

    Or makes, accepts or compares; 1 when the second run is worse.
    """
    if mode := _mode_of(args):
        args.next = "make hil"
        out = args.out or _OUT[mode]
        if out is None:
            raise InputError(f"{_option(mode)} needs --out FILE")
        return {"make_case": _make, "accept": _accept, "compare": _compare}[mode](args, out)
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


def _mode_of(args: argparse.Namespace) -> str | None:
    """Which of the three was asked for, None for none; raises `InputError` where options clash."""
    asked = [name for name in _OF if getattr(args, name)]
    if len(asked) > 1:
        raise InputError(f"{_option(asked[0])} and {_option(asked[1])} are two commands")
    mode = asked[0] if asked else None
    allowed = set(_OF[mode]) if mode else {"json"}
    for name in sorted({name for names in _OF.values() for name in names} - allowed):
        value = getattr(args, name)
        if value is not None and value is not False:
            homes = [_option(m) for m, names in _OF.items() if name in names]
            raise InputError(f"{_option(name)} is for {' and '.join(homes)}")
    flown = () if mode is None else ("recording", "demo", *(_FLOWN if mode != "make_case" else ()))
    for name in flown:
        if getattr(args, name) not in (None, False, 0.0):
            shown = "RECORDING" if name == "recording" else _option(name)
            raise InputError(f"{_option(str(mode))} flies nothing: {shown} is not for it")
    return mode


def _make(args: argparse.Namespace, out: Path) -> int:
    from ground_station.replay.cases.make import Asked, make_case
    from ground_station.replay.cases.outcome import read_outcome
    from ground_station.replay.replay import settings_for

    if args.map is None:
        raise InputError("--make-case needs --map MAP")
    outcome = None if args.from_outcome is None else read_outcome(args.from_outcome)
    bits = args.min_entropy_bits
    said = {name: getattr(args, name) for name in ("rate_hz", "init", "start_s", "duration_s")}
    settings = settings_for(args.preset, args.make_case, stepped=args.stepped, **said)
    asked = Asked(
        args.make_case,
        args.map,
        out,
        args.truth,
        args.payload_id,
        outcome,
        force=args.force,
        flown={name: getattr(settings, name) for name in ("preset", "stepped", *said)},
        settings=[] if bits is None else [f"gate.min_entropy_bits={bits!r}"],
    )
    made = make_case(asked)
    for note in made.notes:
        print(f"blimp replay: {note}", file=sys.stderr)
    print("\n".join(str(path) for path in made.files))
    return 0


def _accept(args: argparse.Namespace, out: Path) -> int:
    from ground_station.files import check_new
    from ground_station.replay.cases.outcome import read_outcome
    from ground_station.replay.cases.truth import MISSING, accept, write_golden

    for name in ("by", "tolerance_m", "tolerance_deg"):
        if getattr(args, name) is None:
            raise InputError(f"--accept needs {_option(name)}")
    check_new(out, force=args.force)
    outcome = read_outcome(args.accept)
    accepted = accept(
        outcome,
        by=args.by,
        tolerance_m=args.tolerance_m,
        tolerance_deg=args.tolerance_deg,
        missing_max=MISSING if args.missing_max is None else args.missing_max,
    )
    write_golden(out, accepted)
    frames = len(outcome.frames)
    print(f"{len(accepted.poses)} poses of {frames} frames, {accepted} -> {out}")
    return 0


def _compare(args: argparse.Namespace, out: Path) -> int:
    from ground_station.files import write_json
    from ground_station.replay.cases.compare import compare
    from ground_station.replay.cases.outcome import read_outcome
    from ground_station.replay.cases.page import write_comparison

    if out.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{out}: the page is an .html file")
    a, b = (read_outcome(folder) for folder in args.compare)
    result = compare(a, b, _allowed(args))
    if args.out is None:
        out.parent.mkdir(parents=True, exist_ok=True)
    names = [_name(path) for path in args.compare]
    write_comparison(out, result, *names)
    if args.json:
        write_json(args.json, document(result, *names))
    print(text(result))
    print(f"\n{out}")
    return 1 if result.failed else 0


def _allowed(args: argparse.Namespace) -> Allowed:
    from ground_station.replay.cases.compare import Allowed

    names = [name for name in _OF["compare"] if name.startswith("fail_over")]
    check_options(args, **dict.fromkeys(names, (0, math.inf)))
    given = {name.removeprefix("fail_"): getattr(args, name) for name in names}
    given = {name: value for name, value in given.items() if value is not None}
    return Allowed(**given, identical=args.identical)


def text(result: Comparison) -> str:
    """A comparison for the terminal: the verdict, then what got worse first."""
    from ground_station.presentation.text import columns
    from ground_station.replay.cases.page import cells

    def row(line: Line) -> list[str]:
        a, b, worse, allowed = cells(line)
        return [line.name, a, b, line.unit, worse, allowed, "WORSE" if line.fails else ""]

    pairs = result.pairs
    lines = [
        f"{len(pairs.a)} frames in both, {len(pairs.only_a)} in A only, {len(pairs.only_b)} in B"
        " only",
        "identical, bit for bit" if result.identical
        else f"{result.first.count} frames differ; the first {result.first.told}",
        *result.notes,
        *(f"{key}: {a} -> {b}" for key, a, b in (result.versions + result.settings)[:_SHOWN]),
        "",
    ]  # fmt: skip
    head = ["", "A", "B", "", "worse by", "allowed", ""]
    lines += columns([head, *(row(line) for line in result.lines[:_SHOWN])])
    return "\n".join(printable(line) for line in lines)


def document(result: Comparison, a: str, b: str) -> dict[str, Any]:
    """A comparison as plain values, every pair of frames in it."""
    import msgspec

    frames_a, frames_b = result.a.frames, result.b.frames
    pairs = result.pairs
    return {
        "schema": "blimp.comparison/1",
        "a": {"name": a, **msgspec.to_builtins(result.a.run)},
        "b": {"name": b, **msgspec.to_builtins(result.b.run)},
        "identical": result.identical,
        "differing": result.first.count,
        "first_difference": {"time_ns": result.first.time_ns, "told": result.first.told},
        "failed": [line.name for line in result.failed],
        "lines": [dataclasses.asdict(line) | {"fails": line.fails} for line in result.lines],
        "states": {name: list(counts) for name, counts in result.states.items()},
        "moves": [[*states, count] for states, count in result.moves.most_common()],
        "settings": result.settings,
        "versions": result.versions,
        "notes": result.notes,
        "only_a_ns": frames_a.time_ns[pairs.only_a].tolist(),
        "only_b_ns": frames_b.time_ns[pairs.only_b].tolist(),
        "frames": {
            "time_ns": result.time_ns.tolist(),
            "position_m": result.position_m.tolist(),
            "rotation_deg": result.rotation_deg.tolist(),
            "state_a": [frames_a.state[k] for k in pairs.a.tolist()],
            "state_b": [frames_b.state[k] for k in pairs.b.tolist()],
        },
    }


def _name(path: Path) -> str:
    """A folder's name as a person would call it: with the one above it where it says nothing."""
    path = path.resolve()
    return f"{path.parent.name}/{path.name}"


def _option(name: str) -> str:
    return "--from" if name == "from_outcome" else "--" + name.replace("_", "-")
