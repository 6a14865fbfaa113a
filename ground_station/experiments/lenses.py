"""Cameras as calibration finds them, each by a simulated film of a printed board."""

from __future__ import annotations

import tempfile
from pathlib import Path

from ground_station.calibration import results
from ground_station.calibration.board import Board
from ground_station.calibration.calibrate import calibrate
from ground_station.calibration.detection import BoardFinder, gather
from ground_station.geometry.camera import Camera
from ground_station.progress import silent
from ground_station.recording.flight import FlightRecording
from ground_station.simulator.simulate import SimulationSettings, simulate

LIGHT = "cloudy"
"""Out of the sun a board has no shadows on it, as who calibrates sees to."""


def find(camera: Camera, processing: str, seed: int, path: Path) -> None:
    """Films the board with a camera and writes what `blimp calibrate` makes of it, a camera's file.

    The same `processing` of its pictures goes on in it as in flight. Raises `CalibrationError`.
    """
    board = Board()
    finder = BoardFinder(board, board.points_m())
    with tempfile.TemporaryDirectory(dir=path.parent) as folder, silent():
        film = Path(folder) / "board.mcap"
        settings = SimulationSettings(
            out=film, scene="board", plan="board", light=LIGHT, seed=seed, camera=camera,
            processing=processing,
        )  # fmt: skip
        if simulate(settings).interrupted:
            raise KeyboardInterrupt
        seen = gather([FlightRecording(film)], [film.name], finder)
    results.write_camera(path, calibrate(seen, finder, [True]), board)
