"""`blimp bench payload`: what the firmware costs, measured on the program that flies."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

HELP = "start, latency, memory and processor time a frame of the firmware"
DESCRIPTION = "Measures the payload's own program on this machine, streaming its test picture."
EPILOG = """\
example:
  blimp bench payload --json out/bench-payload.json
  blimp bench payload --parts stream --seconds 60

Times of two machines do not compare."""

_PARTS = ("start", "stream")


def add_arguments(payload: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    payload.add_argument(
        "--parts", nargs="+", choices=_PARTS, default=list(_PARTS), metavar="PART",
        help=f"what to measure: {', '.join(_PARTS)} (all)",
    )  # fmt: skip
    payload.add_argument("--repetitions", type=int, default=5, metavar="N", help="of the start (5)")
    payload.add_argument(
        "--seconds", type=float, default=10.0, metavar="S",
        help="streamed before memory is read (10)",
    )  # fmt: skip
    payload.add_argument("--json", type=Path, metavar="F", help="write the figures, too")


def run(args: argparse.Namespace) -> int:
    """Measures, prints the tables; raises `GroundStationError` with one line."""
    import sys

    from ground_station.bench import flight
    from ground_station.bench.machine import machine
    from ground_station.errors import check_options
    from ground_station.files import check_outputs, write_json

    check_options(args, repetitions=(1, 3600), seconds=(0.5, 3600))
    check_outputs(args.json)

    def progress(text: str) -> None:
        if sys.stderr.isatty():
            print(text, file=sys.stderr)

    result: dict[str, Any] = {"machine": machine()}
    if "start" in args.parts:
        progress("start")
        result["start"] = flight.start(args.repetitions)
    if "stream" in args.parts:
        progress("stream")
        result["stream"] = flight.stream(args.seconds)
    print("\n".join(report(result)))
    if args.json:
        write_json(args.json, result)
    return 0


def report(result: dict[str, Any]) -> list[str]:
    """The tables as lines of plain text."""
    lines = [f"{result['machine']['cores']} cores, test picture of 640x480 at 30 Hz"]
    if "start" in result:
        lines += ["", *_start(result["start"])]
    if "stream" in result:
        lines += ["", *_stream(result["stream"])]
    return lines


def _start(start: dict[str, Any]) -> list[str]:
    from ground_station.presentation.text import columns

    rows = [["from exec to", "s"]]
    for label, key in (
        ("Python alone", "python_s"),
        ("all imported and built", "ready_s"),
        ("the first access unit at a port", "first_access_unit_s"),
    ):
        rows.append([label, f"{start[key]:.2f}"])
    slowest = [f"{name} {1e3 * spent:.0f}" for name, spent in start["packages_s"].items()]
    modules = [f"{name} {1e3 * spent:.0f}" for name, spent in start["modules_s"].items()]
    return [
        *columns(rows),
        f"medians of {start['repetitions']}; of it {start['import_s']:.2f} s are imports, ms:",
        f"  packages: {', '.join(slowest)}",
        f"  modules: {', '.join(modules)}",
    ]


def _stream(stream: dict[str, Any]) -> list[str]:
    latency, frames = stream["latency_ms"], stream["frames"]
    mappings = [f"{name} {size:.1f}" for name, size in stream["mappings_mb"].items()]
    return [
        f"{frames['captured']} captured, {frames['gated']} gated, {frames['sent']} sent, "
        f"{stream['received']} received",
        f"capture to the last packet at a port: median {latency['p50']:.1f} ms, "
        f"99 % {latency['p99']:.1f}, at most {latency['max']:.1f}; "
        f"processor {stream['processor_ms']:.1f} ms a frame",
        f"resident after {stream['seconds']:g} s: {stream['resident_mb']:.1f} MB, "
        f"at most {stream['peak_mb']:.1f} (bound {stream['limit_mb']:.0f}); in",
        f"  {', '.join(mappings)}",
    ]
