"""`blimp bench payload`: what the firmware costs, measured on the program that flies."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

EPILOG = """\
example:
  blimp bench payload --json out/bench-payload.json
  blimp bench payload --parts instructions --frames 60

Instructions are of this machine's processor and libraries. x264's repeat within 5 %, those of
Python and the bindings within a fifth: a clock that answers slowly is asked again. Times of two
machines do not compare."""

_PARTS = ("start", "stream", "instructions")


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
    payload.add_argument(
        "--frames", type=int, default=30, metavar="N", help="counted under valgrind (30)"
    )
    payload.add_argument("--json", type=Path, metavar="F", help="write the figures, too")


def run(args: argparse.Namespace) -> int:
    """Measures, prints the tables; raises `GroundStationError` with one line."""
    import sys

    from ground_station.bench import figures
    from ground_station.bench.machine import machine
    from ground_station.errors import InputError
    from ground_station.files import write_json

    for name, value, low in (
        ("--repetitions", args.repetitions, 1),
        ("--seconds", args.seconds, 0.5),
        ("--frames", args.frames, 2),
    ):
        if not low <= value <= 3600:
            raise InputError(f"{name} is {value:g}; allowed are {low:g} to 3600")
    if args.json and not args.json.absolute().parent.is_dir():
        raise InputError(f"--json {args.json}: there is no folder {args.json.parent}")

    def progress(text: str) -> None:
        if sys.stderr.isatty():
            print(text, file=sys.stderr)

    result: dict[str, Any] = {"machine": machine()}
    if "start" in args.parts:
        progress("start")
        result["start"] = figures.start(args.repetitions)
    if "stream" in args.parts:
        progress("stream")
        result["stream"] = figures.stream(args.seconds)
    if "instructions" in args.parts:
        result["frames"] = args.frames
        result["instructions"] = figures.instructions(args.frames, progress)
        result["kept"] = figures.kept()
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
    if result.get("instructions"):
        lines += ["", *_instructions(result["instructions"], result["kept"], result["frames"])]
    elif "instructions" in result:
        lines += ["", "instructions: valgrind is not installed (Debian package valgrind)"]
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


def _instructions(
    variants: dict[str, dict[str, Any]], kept: dict[str, float], frames: int
) -> list[str]:
    from ground_station.bench.figures import SENT, payload_alone
    from ground_station.presentation.text import columns

    base = variants[SENT]
    rows = [["thousand instructions a frame", *variants, "share", "kept", "over kept"]]
    for group in base["groups"]:
        rows.append(
            [
                group,
                *(f"{row['groups'][group] / 1e3:.0f}" for row in variants.values()),
                f"{100 * base['groups'][group] / base['total']:.1f} %",
                *_kept(base["groups"][group], kept.get(group)),
            ]
        )
    rows.append(
        [
            "total",
            *(f"{row['total'] / 1e3:.0f}" for row in variants.values()),
            "",
            *_kept(base["total"], sum(kept.values())),
        ]
    )
    alone = {name: payload_alone(row["groups"]) for name, row in variants.items()}
    rows.append(
        [
            "without x264 and test picture",
            *(f"{value / 1e3:.0f}" for value in alone.values()),
            f"{100 * alone[SENT] / base['total']:.1f} %",
            *_kept(alone[SENT], payload_alone(kept)),
        ]
    )
    rows.append(
        [
            "  over the first",
            *(f"{value / alone[SENT]:.2f}" for value in alone.values()),
            "",
            "",
            "",
        ]
    )
    return [
        *columns(rows),
        f"{frames} frames, {base['seconds']:.0f} s under valgrind; at 30 Hz the payload alone "
        f"executes {30 * alone[SENT] / 1e6:.0f} million instructions a second",
    ]


def _kept(value: float, kept: float | None) -> tuple[str, str]:
    if kept is None:
        return "-", "-"
    return f"{kept / 1e3:.0f}", f"{value / kept:.2f}" if kept >= 1e4 else "-"
