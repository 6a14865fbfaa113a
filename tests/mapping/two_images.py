"""The smallest model of COLMAP's that is one: two images that see one point."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from hand_made import model_of

from ground_station.geometry.camera import Camera
from ground_station.map import colmap


def write(folder: Path) -> Path:
    """Its binary files in a new folder; gives the folder."""
    wTc = np.tile(np.eye(4), (2, 1, 1))
    wTc[1, 0, 3] = 1.0
    model = model_of(
        Camera(), wTc, [[0.5, 0.0, 3.0]], names=["a.png", "b.png"], point_id=np.array([5]),
        image=np.array([0, 1]), point=np.array([0, 0]),
        pixel_px=np.array([[395.0, 241.0], [229.0, 241.0]]),
    )  # fmt: skip
    colmap.write(colmap.from_arrays(model, Camera()), folder)
    return folder
