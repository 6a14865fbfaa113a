"""`blimp export`: the poses of a recording for other programs."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

_EPILOG = """\
examples:
  blimp export recordings/main-20260314-101500.mcap --out est.txt
  blimp export flight.mcap --topic /truth/pose --format mcap --out truth.mcap

Times are the camera's. With several payloads in a recording, --topic says whose poses: as
/blimp-1/estimate/pose."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.epilog = _EPILOG
    parser.set_defaults(next="blimp evaluate {out} TRUTH.txt    (where you have the truth)")
    parser.add_argument("recording", type=Path, metavar="RECORDING", help="an .mcap file")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="what to write")
    parser.add_argument(
        "--topic",
        metavar="TOPIC",
        help="which poses (default: the estimates, where they are one payload's)",
    )
    parser.add_argument(
        "--format", choices=("tum", "mcap"), default="tum",
        help="tum: lines of time, position, quaternion (default); mcap: a recording of them alone",
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Writes the file; raises `BlimpError` with one line."""
    from ground_station.errors import InputError
    from ground_station.files import check_outputs, write_text
    from ground_station.recording.export import read_poses, tum, write_mcap

    check_outputs(args.out)
    if args.out.exists() and args.recording.exists() and args.out.samefile(args.recording):
        raise InputError(f"{args.out}: that is the recording itself")
    poses = read_poses(args.recording, args.topic)
    if args.format == "tum":
        write_text(args.out, "".join(tum(poses)))
    else:
        write_mcap(args.out, poses, args.recording.name)
    if poses.cut_reason:
        _log(f"{args.recording}: cut ({poses.cut_reason}); what was whole is there")
    if poses.left_out:
        _log(f"{args.recording}: {poses.left_out} left out: no finite pose or time")
    if poses.again:
        _log(f"{args.recording}: the camera's time begins again {poses.again} times")
    print(f"{len(poses.samples)} poses of {poses.topic} -> {args.out}")
    return 0


def _log(text: str) -> None:
    print(f"blimp export: {text}", file=sys.stderr)
