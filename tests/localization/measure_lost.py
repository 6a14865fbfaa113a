"""Not a test: what the localizer says when it is lost, as its README tells, on flights of yours.

    python tests/localization/measure_lost.py --flights out/loop-*.mcap \\
        --others out/office-*.mcap data/redkitchen@data/redkitchen/camera.toml --json out/lost.json

Kidnapped: a second of one flight, then at once a place of another. Other buildings: their frames,
each on its own and as streams, of which none may be found. Flights are recordings of `blimp
simulate`, which hold their truth and seed; other buildings may be `FOLDER@CAMERA.toml`, too.
"""

from __future__ import annotations

import argparse
import itertools
import math
import os
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

# As the blimp command does, before numpy is imported: small products gain nothing by threads.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from ground_station.arrays import F64
from ground_station.bench.machine import machine
from ground_station.files import write_json
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera, load_camera
from ground_station.geometry.trajectory import Trajectory
from ground_station.localization.attempt import Conditions
from ground_station.localization.estimate import State
from ground_station.localization.extraction import extractor_for
from ground_station.localization.localizer import Localizer
from ground_station.localization.matching import describe
from ground_station.localization.relocalization import Relocalizer
from ground_station.localization.settings import LocalizerSettings, load_preset
from ground_station.map.store import Map, load
from ground_station.recording.flight import trajectory_of
from ground_station.recording.frames import Frame
from ground_station.recording.open import open_input
from pi_firmware.wire.errors import BlimpError
from pi_firmware.wire.recording import RecordingReader

NEAR_M, NEAR_DEG = 0.25, 2.0
"""A pose that a blimp can be steered by, this near to the truth."""
BEFORE, AFTER, SETTLED = 30, 150, 20
"""Frames of a flight before a jump, and after it at most; so many that say TRACKING near the truth
one after the other end it."""
RATE_HZ = 30.0


@dataclass
class Flight:
    """A flight's frames in memory, its camera and, where it is known, its truth."""

    about: str
    camera: Camera
    frames: list[Frame]
    truth: Trajectory | None

    def true_wTc(self, frames: Sequence[Frame]) -> list[F64]:
        """The true pose (4, 4) of each of some of its frames."""
        assert self.truth is not None, f"{self.about} has no truth"
        return [self.truth.at(frame.time_ns) for frame in frames]


def load_flight(spec: str, limit: int | None) -> Flight:
    """A recording, or `FOLDER@CAMERA.toml`; the first `limit` frames of it."""
    path, _, camera_file = spec.partition("@")
    source = open_input(path, RATE_HZ)
    camera = load_camera(camera_file) if camera_file else source.camera
    assert camera is not None, f"{path} has no camera"
    about, truth = "/".join(Path(path).parts[-2:]), None
    if path.endswith(".mcap"):
        truth = trajectory_of(path)
        made = RecordingReader(path).metadata_table("simulation")
        about = " ".join([about, *(made[key] for key in ("light", "seed") if key in made)])
    return Flight(about, camera, list(itertools.islice(source, limit)), truth)


def localizer_of(map_: Map, camera: Camera, settings: LocalizerSettings) -> Localizer:
    return Localizer(map_, camera, extractor_for(map_.info, settings.features), settings)


def draw_places(
    lengths: Sequence[int], rng: np.random.Generator, before: int, after: int
) -> tuple[int, int, int, int]:
    """A flight and a first frame before, and another flight and a first frame after a jump."""
    a = int(rng.integers(len(lengths)))
    b = int((a + rng.integers(1, len(lengths))) % len(lengths)) if len(lengths) > 1 else a
    i, j = (int(rng.integers(max(1, n))) for n in (lengths[a] - before, lengths[b] - after))
    return a, i, b, j


@dataclass(frozen=True)
class Recovery:
    """What followed a jump; times in seconds from the first frame of the new place.

    `recovered_s`: until TRACKING near the truth, infinite when never. `kept_s`: how long the first
    frames went on TRACKING elsewhere. `wrong`: frames that said TRACKING and were not near.
    `worst_m`: the farthest of all that said TRACKING, NaN when none did.
    """

    recovered_s: float
    kept_s: float
    wrong: int
    worst_m: float


def recovery(told: Sequence[tuple[bool, float, float]]) -> Recovery:
    """Of the frames after a jump: whether each says TRACKING, metres and degrees off.

    These are NaN without a pose; a frame that says TRACKING without one is wrong.
    """
    says, m, deg = np.array(told, np.float64).T
    near = (m <= NEAR_M) & (deg <= NEAR_DEG)
    good, wrong = (says > 0) & near, (says > 0) & ~near
    off_m = m[(says > 0) & np.isfinite(m)]
    kept = len(told) - 1 if wrong.all() else int(np.argmin(wrong))
    return Recovery(
        float(np.argmax(good)) / RATE_HZ if good.any() else math.inf,
        kept / RATE_HZ,
        int(wrong.sum()),
        float(off_m.max()) if len(off_m) else math.nan,
    )


def after_jump(localizer: Localizer, frames: Sequence[Frame], true_wTc: Sequence[F64]) -> Recovery:
    """What a localizer says after a jump, to the truth of the last frames, until it has settled."""
    first, told, settled = len(frames) - len(true_wTc), [], 0
    for k, frame in enumerate(frames):
        time_ns = 1_000_000_000 + round(k * 1e9 / RATE_HZ)
        estimate = localizer.process(time_ns, frame.image, k, frame.exposure_s)
        if k < first:
            continue
        m = deg = math.nan
        if estimate.wTc is not None:
            step = poses.inverse(true_wTc[k - first]) @ estimate.wTc
            m = float(np.linalg.norm(step[:3, 3]))
            deg = math.degrees(float(poses.rotation_angle(step[:3, :3])))
        told.append((estimate.state is State.TRACKING, m, deg))
        settled = settled + 1 if told[-1][0] and m <= NEAR_M and deg <= NEAR_DEG else 0
        if settled == SETTLED:
            break
    return recovery(told)


def kidnapped(
    map_: Map, settings: LocalizerSettings, flights: Sequence[Flight], jumps: int, seed: int
) -> list[Recovery]:
    """From the truth of one flight to a place of another, on its own from then on."""
    rng, found = np.random.default_rng(seed), []
    for _ in range(jumps):
        a, i, b, j = draw_places([len(f.frames) for f in flights], rng, BEFORE, AFTER)
        old, new = flights[a].frames[i : i + BEFORE], flights[b].frames[j : j + AFTER]
        localizer = localizer_of(map_, flights[b].camera, settings)
        localizer.set_initial_pose(flights[a].true_wTc(old[:1])[0], 1_000_000_000)
        found.append(after_jump(localizer, [*old, *new], flights[b].true_wTc(new)))
    return found


def accepted(
    map_: Map, settings: LocalizerSettings, flights: Sequence[Flight], count: int
) -> dict[str, int]:
    """Of other buildings: frames asked alone and found, frames of streams and those localized."""
    every = [(flight, frame) for flight in flights for frame in flight.frames]
    chosen = every[:: max(1, len(every) // count)][:count]
    extractor, alone, streamed = extractor_for(map_.info, settings.features), 0, 0
    for flight, frame in chosen:
        finder = Relocalizer(map_, flight.camera, settings.recovery, settings.seed)
        seen = describe(extractor.extract(frame.image), flight.camera, Conditions())
        found = finder.candidates(seen)
        alone += not isinstance(found, str) and not isinstance(finder.alone(found), str)
    for flight in flights:
        localizer = localizer_of(map_, flight.camera, settings)
        streamed += sum(
            localizer.process(frame.time_ns, frame.image, frame.index, frame.exposure_s).localized
            for frame in flight.frames
        )
    return {"asked": len(chosen), "found": alone, "frames": len(every), "localized": streamed}


def main(arguments: Sequence[str] | None = None) -> int:
    """Measures what flights are given for; 2 with one line for what cannot be."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--map", default="maps/atrium", help="the flights' map (maps/atrium)")
    parser.add_argument("--flights", nargs="*", default=[], help="flights to jump between")
    parser.add_argument("--others", nargs="*", default=[], help="flights of other buildings")
    parser.add_argument("--limit", type=int, help="most frames of a flight, for a quick look")
    parser.add_argument("--jumps", type=int, default=200, help="kidnappings (200)")
    parser.add_argument("--count", type=int, default=1000, help="frames asked alone (1000)")
    parser.add_argument("--seed", type=int, default=0, help="of the places that are drawn (0)")
    parser.add_argument("--json", metavar="F", help="write everything measured to this file")
    args = parser.parse_args(arguments)
    settings, told = load_preset("default"), vars(args) | {"machine": machine()}
    try:
        flights = [load_flight(spec, args.limit) for spec in args.flights]
        others = [load_flight(spec, args.limit) for spec in args.others]
        map_ = load(args.map)
        if flights:
            jumps = kidnapped(map_, settings, flights, args.jumps, args.seed)
            times = [jump.recovered_s for jump in jumps]
            # Between a time and never there is nothing to interpolate.
            p50, p95 = np.percentile(times, [50, 95], method="inverted_cdf")
            print(
                f"kidnapped {len(jumps)} times between {', '.join(f.about for f in flights)}: "
                f"TRACKING after {p50:.2f} s (median), {p95:.2f} s (95 %), in 1 s in "
                f"{np.mean([t <= 1.0 for t in times]):.1%}; {sum(j.wrong > 0 for j in jumps)} with "
                f"a wrong TRACKING (kept {max(j.kept_s for j in jumps):.2f} s at most), "
                f"worst {np.nanmax([j.worst_m for j in jumps]):.3f} m"
            )
            told["kidnapped"] = [asdict(jump) for jump in jumps]
        if others:
            told["others"] = accepted(map_, settings, others, args.count)
            print(f"other buildings, {', '.join(f.about for f in others)}: {told['others']}")
        if args.json:
            write_json(args.json, told)
    except BlimpError as error:
        print(f"measure_lost: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
