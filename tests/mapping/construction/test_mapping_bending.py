"""A map that a wrong lens bends, and what it knows of that."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from built_scene import look_at
from hand_made import in_picture, observed

from ground_station.arrays import F64
from ground_station.geometry import poses
from ground_station.geometry.alignment import align
from ground_station.geometry.camera import THESIS_CAMERA, Camera
from ground_station.map import colmap
from ground_station.map.model import Model
from ground_station.mapping.construction import bending
from ground_station.mapping.sfm import adjustment

SIZE_M = np.array([12.0, 9.0, 3.0])


def walked(camera: Camera, images: int = 60, count: int = 900) -> Model:
    """The true model of what a camera sees that is carried round a room and looks at its walls."""
    rng = np.random.default_rng(2)
    points = rng.uniform(0, 1, (count, 3)) * SIZE_M
    wall = rng.integers(0, 2, count)
    points[np.arange(count), wall] = np.where(rng.random(count) < 0.5, 0.0, SIZE_M[wall])
    rows, wTc = [], []
    for angle in np.linspace(0, 2 * np.pi, images, endpoint=False):
        out = np.array([np.cos(angle), np.sin(angle), 0.0])
        wTc.append(look_at(SIZE_M / 2 + 0.2 * out * SIZE_M, SIZE_M / 2 + 2 * out * SIZE_M))
        local = poses.transform(poses.inverse(wTc[-1]), points)
        pixels = camera.project(local)
        inside = in_picture(camera, local, pixels, 1.0)
        rows.append((np.flatnonzero(inside), pixels[inside]))
    return observed(camera, np.array(wTc), points, rows, least=3)[0]


@pytest.mark.parametrize("share", [0.003, -0.003])
def test_it_tells_where_the_points_are_with_another_lens(share: float) -> None:
    true = replace(THESIS_CAMERA, readout_s=0.0)
    wrong = replace(true, fx_px=true.fx_px / (1 + share), fy_px=true.fy_px / (1 + share))
    model = walked(true)
    points = model.position
    pixels = true.distort((model.pixel_px - model.pinhole[2:]) / model.pinhole[:2])
    believed = replace(model, camera=wrong, pixel_px=wrong.undistort_to_pinhole(pixels))
    bent = colmap.from_arrays(believed, wrong)
    adjustment.adjust(bent, loss_px=0.5, threads=1, max_iterations=100)
    follows = bending.by_focal(bent, model.point_id, loss_px=0.5, threads=1)
    assert follows.dtype == np.float32 and follows.shape == points.shape
    _, position = colmap.positions(bent, believed)

    def off_m(moved: F64) -> float:
        """Of the true places, brought together."""
        back = align(position + moved, points, with_scale=True)
        return float(np.sqrt(np.mean(np.square(back.apply(position + moved) - points))))

    assert off_m(0 * points) > 0.003
    assert off_m(share * follows) < 0.3 * off_m(0 * points)
    some = model.point_id[3:90:4]
    again = bending.by_focal(bent, some, loss_px=0.5, threads=1)
    assert np.allclose(again, follows[3:90:4], atol=1e-3)
