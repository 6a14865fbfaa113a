"""`blimp simulate`: its arguments and what it prints. Heavy modules are imported when it runs."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ground_station.simulator.simulate import SimulationSettings

EXAMPLE = """\
examples:
  blimp simulate --plan loop --light cloudy --seed 7 --out out/loop.mcap
  blimp simulate --light-steps 5:0.01,6:1 --duration-s 10 --out out/lights-off.mcap
  blimp simulate --scene hall --plan stills --lens-error 0.01 --out out/stills.mcap
  blimp simulate --scene rooms --plan headset --seed 3 --out out/headset.mcap
  blimp simulate --scene board --plan board --light cloudy --out out/board.mcap"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the options of `blimp simulate`."""
    parser.epilog = EXAMPLE
    parser.set_defaults(next="blimp map build {out} --out maps/NAME")
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    add = parser.add_argument
    add(
        "--scene",
        default="atrium",
        help="atrium, office, corridor, hall (repeating panels), hall-glazed (a wall of dark"
        " glass), hall-above (the floor above: panels at the same places), hall-above-alike (of"
        " the same prints), rooms (a flat), board (a calibration board), and procedural, 1 to 999:"
        " interior-N (odd halls, even offices), passage-N, stairwell-N;"
        " atrium-moved (other furniture; -25 and -50: a quarter, half of it moved),"
        " atrium-moved-posted (and other posters) (default: atrium)",
    )
    add(
        "--plan",
        default="loop",
        help="mapping, loop (default), small-circle, fast, corridor, tour (of an interior); of a"
        " person's camera: stills (12 places, 8 headings, a wide lens), headset (a walk through"
        " --scene rooms), walk (round an interior with a phone), board (about the"
        " board of --scene board, as one calibrates)",
    )
    add(
        "--light",
        default="noon",
        help="noon, cloudy, evening, sunset, or 0h to 23h of a day (default: noon)",
    )
    add("--seed", type=int, default=0, help="seed of path, draughts and noise (default: 0)")
    add("--out", type=Path, metavar="F.mcap", help="recording to write")
    add("--duration-s", type=float, metavar="S", help="length of the flight (default: the plan's)")
    add(
        "--rate-hz",
        type=float,
        metavar="R",
        help="frames a second (default: the plan's; of flights, 30)",
    )
    add(
        "--camera",
        type=Path,
        metavar="CAMERA.toml",
        help="the lens that takes the pictures (default: the plan's; of flights, the thesis's)",
    )
    add(
        "--lens-error",
        type=float,
        default=0.0,
        metavar="SHARE",
        help="the recording names focal lengths that are wrong by this share: 0.01 is 1 %% too long"
        " (default: 0)",
    )
    add(
        "--draught-m-s",
        type=float,
        metavar="V",
        help="deviation of the air's speed (default: 0.05)",
    )
    add(
        "--people",
        type=int,
        default=0,
        metavar="N",
        help="so many walk back and forth (default: 0)",
    )
    add(
        "--processing",
        default="none",
        metavar="P",
        help="of pictures in the camera: none (default: a perfect sensor with noise) or camera (a"
        " mosaic of colours, demosaiced, denoised, sharpened)",
    )
    add("--build", metavar="NAME", help="the blimp, of hw/builds.toml (default: atrium)")
    add(
        "--exposure-steps",
        default="",
        metavar="T:EV[,T:EV...]",
        help="from T seconds on, exposures off by EV from what auto exposure asks for:"
        " 5:1,10:-1,15:0",
    )
    add(
        "--light-steps",
        default="",
        metavar="T:SHARE[,T:SHARE...]",
        help="from T seconds on, this share of the light: 5:0.01,6:1 is a second of lights off",
    )
    add(
        "--flicker",
        type=float,
        default=0.0,
        metavar="SHARE",
        help="light that swings by this share, 100 times a second: bands in exposures other than"
        " whole hundredths of a second (default: 0)",
    )
    add(
        "--longest-exposure-s",
        type=float,
        metavar="S",
        help="no exposure is longer, gain does the rest (default: 1/60)",
    )
    quality = parser.add_mutually_exclusive_group()
    quality.add_argument(
        "--crf", type=float, default=20.0, help="x264's quality, 0 (best) to 51 (default: 20)"
    )
    quality.add_argument("--bitrate-kbps", type=int, metavar="B", help="bit rate instead of --crf")
    add("--truth", type=Path, metavar="TUM.txt", help="also write the true poses as TUM text")
    add(
        "--points",
        type=Path,
        metavar="PAIRS.csv",
        help="also write observations of surveyed points",
    )
    add("--json", type=Path, metavar="F", help="write what was made and how long it took")
    add(
        "--sample", type=Path, metavar="FOLDER",
        help="make the sample that ships (flights, floor plan, known points) and nothing else",
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Runs it; raises `SimulatorError` on what a person can fix. 130 after Ctrl-C."""
    from ground_station.simulator.scene import SimulatorError

    if args.sample is not None:
        from ground_station.simulator.sample import make_sample

        made = make_sample(args.sample)
        for path in made:
            print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")
        return 0
    if args.out is None:
        raise SimulatorError("--out is missing: the recording to write, such as out/flight.mcap")

    from ground_station.progress import Progress
    from ground_station.simulator.simulate import simulate

    settings = settings_from(args)
    with Progress(f"{args.out.name}, frames", None) as progress:
        result = simulate(settings, lambda done, total: progress.step(total))
    if args.json is not None:
        from dataclasses import asdict

        from ground_station.files import write_json

        write_json(args.json, asdict(result))
    print(
        f"{result.out}: {result.frames} frames, {result.duration_s:g} s,"
        f" {result.bytes / 1e6:.2f} MB, seed {result.seed};"
        f" {1e3 * result.frame_s:.0f} ms a frame after {result.setup_s:.0f} s of preparation"
    )
    if result.interrupted:
        print(f"interrupted: the recording holds the {result.frames} frames taken until then")
        return 130
    return 0


def settings_from(args: argparse.Namespace) -> SimulationSettings:
    """The settings that the arguments say."""
    from dataclasses import fields

    from ground_station.geometry.camera import load_camera
    from ground_station.simulator.simulate import SimulationSettings

    names = {field.name for field in fields(SimulationSettings)}
    said = {name: value for name, value in vars(args).items() if name in names}
    camera = None if args.camera is None else load_camera(args.camera)
    return SimulationSettings(**said | {"camera": camera})
