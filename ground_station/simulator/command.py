"""`blimp simulate`: its arguments and what it prints. Heavy modules are imported when it runs."""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ground_station.simulator.simulate import SimulationSettings

EXAMPLE = "example: blimp simulate --plan loop --light cloudy --seed 7 --out out/loop.mcap"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the options of `blimp simulate`."""
    parser.epilog = EXAMPLE
    add = parser.add_argument
    add("--scene", default="atrium", help="building to fly in (default: atrium)")
    add("--plan", default="loop", help="mapping, loop, small-circle or fast (default: loop)")
    add("--light", default="noon", help="noon, cloudy, evening or sunset (default: noon)")
    add("--seed", type=int, default=0, help="seed of path, draughts and noise (default: 0)")
    add("--out", type=Path, metavar="F.mcap", help="recording to write")
    add("--duration-s", type=float, metavar="S", help="length of the flight (default: the plan's)")
    add("--rate-hz", type=float, default=30.0, metavar="R", help="frames a second (default: 30)")
    quality = parser.add_mutually_exclusive_group()
    quality.add_argument(
        "--crf", type=float, default=20.0, help="x264's quality, 0 (best) to 51 (default: 20)"
    )
    quality.add_argument("--bitrate-kbps", type=int, metavar="B", help="bit rate instead of --crf")
    add("--truth", type=Path, metavar="TUM.txt", help="also write the true poses as TUM text")
    add("--points", type=Path, metavar="PAIRS.csv", help="also write sights of surveyed points")
    add("--json", type=Path, metavar="F", help="write what was made and how long it took")
    add(
        "--sample", type=Path, metavar="FOLDER",
        help="make the sample that ships (flights, floor plan, known points) and nothing else",
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Runs it; raises `SimulatorError` on what a person can mend. 130 after Ctrl-C."""
    from ground_station.simulator.scene import SimulatorError

    if args.sample is not None:
        from ground_station.simulator.sample import make_sample

        made = make_sample(args.sample, Reporter)
        for path in made:
            print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")
        return 0
    if args.out is None:
        raise SimulatorError("--out is missing: the recording to write, such as out/flight.mcap")

    from ground_station.simulator.simulate import simulate

    settings = settings_from(args)
    with Reporter(args.out.name) as report:
        result = simulate(settings, report)
    if args.json is not None:
        write_json(args.json, result.as_dict())
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
    from ground_station.simulator.simulate import SimulationSettings

    return SimulationSettings(
        out=args.out, scene=args.scene, plan=args.plan, light=args.light, seed=args.seed,
        duration_s=args.duration_s, rate_hz=args.rate_hz, crf=args.crf,
        bitrate_kbps=args.bitrate_kbps, truth=args.truth, points=args.points,
    )  # fmt: skip


def write_json(path: Path, document: dict[str, object]) -> None:
    """Writes JSON, beside and renamed; raises `SimulatorError`."""
    from ground_station.simulator.scene import SimulatorError

    part = path.with_name(path.name + ".part")
    try:
        part.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
        part.replace(path)
    except OSError as error:
        raise SimulatorError(f"{path}: {error.strerror or error}") from None


class Reporter:
    """Progress on standard error: a bar on a terminal, else a line every ten seconds."""

    def __init__(self, title: str) -> None:
        from tqdm import tqdm

        self._title, self._last = title, time.monotonic()
        self._bar = tqdm(desc=title, unit="frame", disable=None) if sys.stderr.isatty() else None

    def __enter__(self) -> Reporter:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def __call__(self, done: int, total: int) -> None:
        """Says that `done` of `total` frames are taken."""
        if self._bar is not None:
            self._bar.total = total
            self._bar.update(done - self._bar.n)
        elif done == total or time.monotonic() - self._last >= 10:
            self._last = time.monotonic()
            print(f"{self._title}: {done} of {total} frames", file=sys.stderr, flush=True)
