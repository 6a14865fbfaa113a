"""`blimp record`: receives and records payloads, without the rest of the service."""

from __future__ import annotations

import argparse
import math
import shlex
import time
from pathlib import Path
from typing import TYPE_CHECKING

from ground_station.service import add_lan_argument, add_settings_arguments
from pi_firmware.wire.text import printable

if TYPE_CHECKING:
    from ground_station.service.bus_messages import Message

_EPILOG = """\
examples:
  blimp record --out recordings
  blimp record --out recordings --seconds 60 --camera camera.toml
  blimp record --out recordings --lan       # payloads on the network, with `blimp keys`

It takes the place of `blimp serve` and listens where that would: one of the two can run. A file
ends at the configuration's recording.max_file_MB or max_file_s, and the next begins. The exit
status is 1 when nothing was recorded, or the recording ended by itself."""

_STEP_S = 0.1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.epilog = _EPILOG
    parser.set_defaults(next="blimp doctor --lan    (nothing was recorded)")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder of the recordings (recording.folder)"
    )
    parser.add_argument("--port", type=int, metavar="P", help="the video's UDP port (video.port)")
    parser.add_argument("--seconds", type=float, metavar="S", help="end by itself after so long")
    parser.add_argument(
        "--camera", metavar="CAMERA.toml", help="calibration that is put into the recordings"
    )
    add_settings_arguments(parser)
    add_lan_argument(parser)


def run(args: argparse.Namespace) -> int:
    """Records until a signal or the given time; raises a `BlimpError` when it cannot start."""
    from ground_station.errors import InputError
    from ground_station.geometry.camera import load_camera
    from ground_station.service import lan, settings
    from ground_station.service.bus_messages import STATION, EventMessage, PayloadMessage
    from ground_station.service.ending import ending
    from ground_station.service.intake.process import Intake

    if args.seconds is not None and not (math.isfinite(args.seconds) and args.seconds > 0):
        raise InputError(f"--seconds is {args.seconds:g}; it must be more than 0")
    overrides = [*args.set]
    if args.port is not None:
        overrides.append(f"video.port={args.port}")
    if args.out is not None:
        overrides.append(f"recording.folder={args.out}")
    loaded = settings.load(args.config, overrides)
    if args.lan is not None:
        loaded = lan.announced(loaded, args.lan)
    path = args.camera or loaded.map.camera
    camera = load_camera(path) if path else None
    stop = ending(None)
    accounts: dict[str, dict[str, int]] = {}

    def take(_: str, payload_id: str, note: Message) -> None:
        """Prints events, and keeps each payload's newest account."""
        if isinstance(note, EventMessage):
            who = "" if payload_id == STATION else f"{payload_id}: "
            print(f"{who}{note.name}: {printable(note.text, 300, ' ')}", flush=True)
        elif isinstance(note, PayloadMessage) and note.stream.get("packets"):
            accounts[payload_id] = note.frames

    with Intake(loaded, take, camera=camera) as intake:
        first = intake.recorder.start()
        until_s = math.inf if args.seconds is None else time.monotonic() + args.seconds
        while not stop.wait(_STEP_S) and time.monotonic() < until_s and intake.recorder.file:
            intake.step()
    state = intake.recorder.state()
    if accounts:
        made = shlex.quote(str(Path(loaded.recording.folder) / first))
        args.next = f"blimp map build {made} --out maps/NAME"
    for payload_id, frames in sorted(accounts.items()):
        print(f"{payload_id}: " + ", ".join(f"{n} {name}" for name, n in sorted(frames.items())))
    return 1 if state.problem or not accounts else 0
