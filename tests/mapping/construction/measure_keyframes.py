"""Measures keyframes against every n-th frame of a 30 Hz flight. Minutes; not a test.

How many, how sharp against the frames around them, what choosing costs a frame, and what a map of
either is worth: images registered, and camera centres against the true poses after Sim(3).

    .venv/bin/python tests/mapping/construction/measure_keyframes.py FLIGHT.mcap --json out/k.json

Without a flight, the sample's. The limit of `max_images` is swept, so that thinning shows, too.
"""

from __future__ import annotations

import argparse
import dataclasses
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ground_station.files import write_json
from ground_station.geometry.alignment import align
from ground_station.mapping.construction import keyframes
from ground_station.mapping.construction.build import build_map
from ground_station.mapping.construction.inputs import ChosenFrames
from ground_station.mapping.settings import MappingSettings, load_settings
from ground_station.presentation.text import columns
from ground_station.recording.flight import FlightRecording, trajectory_of
from ground_station.recording.frames import Frame

ROOT = Path(__file__).parents[3]


class Shaken:
    """A flight in which every fifth frame or so is smeared, a few in a row: jolts of a hand."""

    def __init__(self, source: FlightRecording, seed: int | None) -> None:
        self._source, self._seed, self.camera = source, seed, source.camera

    def __iter__(self) -> Iterator[Frame]:
        for frame in self._source:
            if self._seed is None:
                yield frame
                continue
            rng = np.random.default_rng([self._seed, frame.index // 4])  # four frames alike
            length_px = int(rng.integers(6, 30)) if rng.random() < 0.22 else 1
            size = (length_px, 1) if rng.random() < 0.5 else (1, length_px)
            image = np.asarray(cv2.blur(frame.image, size), np.uint8)
            yield dataclasses.replace(frame, image=image)


def build(
    flight: Path, indices: list[int], settings: MappingSettings, shake: int | None
) -> dict[str, Any]:
    """A map of these frames, and how far its camera centres are off."""
    truth = trajectory_of(flight)
    source = Shaken(FlightRecording(flight, ChosenFrames(indices=frozenset(indices))), shake)
    folder = Path(tempfile.mkdtemp())
    began_s = time.monotonic()
    try:
        assert source.camera is not None
        map_ = build_map(source, source.camera, settings, folder / "map", total=len(indices))
    finally:
        shutil.rmtree(folder)
    kf = map_.keyframes
    at = [truth.nearest(int(t)) for t in kf.time_ns]
    fit = align(kf.wTc[:, :3, 3], truth.position_m[at], True)
    off = np.linalg.norm(fit.apply(kf.wTc[:, :3, 3]) - truth.position_m[at], axis=1)
    return {
        "registered": len(kf),
        "landmarks": len(map_.landmarks),
        "rmse_m": float(np.sqrt(np.mean(off**2))),
        "max_m": float(off.max()),
        "build_s": time.monotonic() - began_s,
    }


def main() -> int:
    """One table, one row a way of choosing."""
    parser = argparse.ArgumentParser()
    parser.add_argument("flight", type=Path, nargs="?", default=ROOT / "maps/atrium/flight.mcap")
    parser.add_argument("--most", type=int, nargs="+", default=[1000, 60])
    parser.add_argument("--settings", type=Path, help="settings file (default: the shipped)")
    parser.add_argument("--shake", type=int, metavar="SEED", help="smear frames in bursts")
    parser.add_argument("--no-maps", action="store_true", help="choose only")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    settings = load_settings(args.settings)
    source = Shaken(FlightRecording(args.flight), args.shake)
    assert source.camera is not None
    began_s, cpu_s = time.monotonic(), time.process_time()
    figures = keyframes.measure(source, source.camera, settings.keyframes)
    took_s, cpu_s = time.monotonic() - began_s, time.process_time() - cpu_s
    read_s = time.process_time()
    decoded = sum(1 for _ in source)
    read_s = time.process_time() - read_s
    print(
        f"{len(figures)} frames: {1e3 * took_s / len(figures):.2f} ms a frame, "
        f"{1e3 * cpu_s / len(figures):.2f} ms of CPU, {1e3 * read_s / decoded:.2f} reading; "
        f"{figures.motion[-1]:.1f} keyframes' motion, {figures.segment[-1]} cuts, "
        f"{int((~figures.followed).sum())} frames not followed"
    )
    sharp = keyframes.relative_sharpness(figures)
    rows: list[dict[str, Any]] = []
    for most in args.most:
        chosen = keyframes.choose([figures], most, settings.keyframes)
        place = np.searchsorted(figures.index, chosen.index[0])
        step = len(figures) / len(place)
        every = np.floor(np.arange(len(place)) * step).astype(int)
        for name, at in (("keyframes", place), ("every n-th", every)):
            row = {
                "chosen": name,
                "most": most,
                "images": len(at),
                "due": chosen.due,
                "blurred": int((sharp[at] < settings.keyframes.min_sharpness).sum()),
                "sharp_median": float(np.median(sharp[at])),
                "sharp_p5": float(np.percentile(sharp[at], 5)),
                "longest_motion": float(np.diff(figures.motion[at]).max(initial=0.0)),
            }
            if not args.no_maps:
                plain = dataclasses.replace(settings, max_images=5000)
                row |= build(args.flight, figures.index[at].tolist(), plain, args.shake)
            rows.append(row)
    shown = [[f"{v:.3f}" if isinstance(v, float) else str(v) for v in row.values()] for row in rows]
    print("\n".join(columns([list(rows[0]), *shown])))
    if args.json:
        write_json(args.json, {"flight": args.flight.name, "rows": rows})
    return 0


if __name__ == "__main__":
    sys.exit(main())
