"""Not a test: calibrates from simulated recordings of a board, seed by seed, and prints the errors.

    .venv/bin/python tests/calibration/measure.py --seeds 11:17 [--keep FOLDER]

The thesis's lens and a readout of 20 ms, 640x480 at 30 Hz through H.264, 8 ms of exposure, noise.
What calibrates is the command itself; the true camera is looked at only to print how far off it is.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))
from board_flight import write_board_flight
from board_views import BoardCamera, carried

from ground_station.calibration.board import Board, write_board
from ground_station.cli import main as blimp
from ground_station.geometry.camera import THESIS_CAMERA as TRUE
from ground_station.geometry.camera import load_camera


def one(seed: int, folder: Path, waypoints: int) -> dict[str, float] | None:
    """The errors of one seed's calibration."""
    rng = np.random.default_rng(seed)
    board = Board()
    motion = carried(TRUE, board, rng, waypoints, rest_s=0.25, move_s=0.75)
    jitter = rng.uniform(-0.001, 0.001, int((motion.duration_s - 0.1) * 30))
    times = 0.05 + np.arange(len(jitter)) / 30 + jitter
    flight = folder / f"board-{seed}.mcap"
    if not flight.exists():
        write_board_flight(flight, BoardCamera(TRUE, board), motion, times, 0.008, rng)
    write_board(folder / "board.toml", board)
    out, figures = folder / f"camera-{seed}.toml", folder / f"calibration-{seed}.json"
    began_s = time.process_time()
    status = blimp(
        ["calibrate", str(flight), "--board", str(folder / "board.toml"), "--out", str(out),
         "--json", str(figures), "--report", str(folder / f"calibration-{seed}.html")]
    )  # fmt: skip
    cpu_s = time.process_time() - began_s
    if status:
        return None
    found, document = load_camera(out), json.loads(figures.read_text())
    sigma = document["sigma"]
    return {
        "fx_percent": 100 * abs(found.fx_px / TRUE.fx_px - 1),
        "fy_percent": 100 * abs(found.fy_px / TRUE.fy_px - 1),
        "centre_px": math.hypot(found.cx_px - TRUE.cx_px, found.cy_px - TRUE.cy_px),
        "readout_percent": 100 * abs(found.readout_s / TRUE.readout_s - 1),
        "readout_sigmas": abs(found.readout_s - TRUE.readout_s) / document["readout"]["sigma_s"],
        "worst_sigmas": max(
            abs(getattr(found, name) - getattr(TRUE, name)) / sigma[name] for name in sigma
        ),
        "rms_px": document["rms_px"],
        "views": document["frames"]["used"],
        "lens_px": lens_error_px(found),
        "cpu_s": cpu_s,
        "frames": document["frames"]["looked_at"],
    }


def lens_error_px(found: object) -> float:
    """How far pixels' rays go astray, at most, over the picture: in pixels, no turn allowed for."""
    v, u = np.mgrid[0 : TRUE.height_px : 20, 0 : TRUE.width_px : 20]
    grid = np.stack([u.ravel(), v.ravel()], 1)
    return float(np.linalg.norm(found.distort(TRUE.undistort(grid)) - grid, axis=1).max())  # type: ignore[attr-defined]


def main() -> int:
    """Every seed, then median and worst."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", default="11:16")
    parser.add_argument("--waypoints", type=int, default=13)
    parser.add_argument("--keep", type=Path)
    args = parser.parse_args()
    begin, end = map(int, args.seeds.split(":"))
    folder = args.keep or Path(tempfile.mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for seed in range(begin, end):
        row = one(seed, folder, args.waypoints)
        print(
            f"seed {seed}: {row if row is None else {k: round(v, 4) for k, v in row.items()}}",
            flush=True,
        )
        if row is not None:
            rows.append(row)
    for name in rows[0] if rows else ():
        values = [row[name] for row in rows]
        print(f"{name:16} median {np.median(values):9.4f}   worst {max(values):9.4f}")
    return 0 if len(rows) == end - begin else 1


if __name__ == "__main__":
    sys.exit(main())
