"""The pictures are where the ground truth says: lens, rolling shutter and blur."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from ground_station.arrays import F64
from ground_station.geometry import poses
from ground_station.geometry.camera import THESIS_CAMERA, Camera
from ground_station.simulator.imaging import (
    AutoExposure,
    FrameMaker,
    Sensor,
    covering_pinhole,
    row_offsets_s,
)
from ground_station.simulator.known_points import project_rolling
from ground_station.simulator.motion import Motion, Mount
from ground_station.simulator.processing import PROCESSINGS
from tests.simulator.conftest import Room, open_room

GLOBAL = replace(THESIS_CAMERA, readout_s=0.0)


def moving(velocity_m_s: F64, rates_rad_s: F64, start: F64 | None = None) -> Motion:
    """Straight and evenly turning about time 0."""
    t = np.linspace(-0.5, 0.5, 101)
    position = (np.array([0.6, -0.1, 1.6]) if start is None else start) + t[:, None] * velocity_m_s
    angles = np.array([0.15, 0.1, 0.03]) + t[:, None] * rates_rad_s
    return Motion(t, position, angles, Mount(0.0, 0.0, 4.0))


STILL = moving(np.zeros(3), np.zeros(3))
FAST = moving(np.array([2.5, 1.5, -0.5]), np.array([0.8, 0.3, -0.4]))


def measured_and_expected(
    room: Room, camera: Camera, motion: Motion, exposure_s: float, renders: int
) -> tuple[F64, F64]:
    """Centroids of the dots in a frame, and of their true projections, pixels."""
    image = room.maker(camera, renders).radiance(motion, 0.0, exposure_s)[..., 1]
    grid = np.linspace(-0.95, 0.95, 9)
    measured, expected = [], []
    cTw = poses.inverse(motion.wTc([0.0])[0])
    for centre, (a, b) in zip(room.centres, room.half_edges, strict=True):
        outline = centre + np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]) @ np.stack([a, b]) * 1.6
        x, y, z = poses.transform(cTw, centre[None])[0]
        # Beyond the lens's field its polynomial folds back, and a fisheye's picture is dark.
        outside = abs(x) > 0.75 * z or abs(y) > 0.6 * z
        if camera.model == "fisheye":
            outside = np.hypot(x, y) > 3.7 * z
        if z < 0.3 or outside:
            continue
        box = project_rolling(camera, motion, 0.0, outline)
        if not np.isfinite(box).all():
            continue
        low, high = np.floor(box.min(axis=0)).astype(int), np.ceil(box.max(axis=0)).astype(int)
        far = [camera.width_px - 4, camera.height_px - 4]
        if (low < 3).any() or (high > far).any() or (high - low).min() < 8:
            continue
        inside = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
        pixels = project_rolling(camera, motion, 0.0, centre + inside @ np.stack([a, b]))
        window = image[low[1] : high[1] + 1, low[0] : high[0] + 1].astype(float)
        weight = np.maximum(window - window.min() - 0.05, 0)
        u, v = np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1))
        measured.append([(weight * u).sum(), (weight * v).sum()] / weight.sum())
        expected.append(projected_area_centroid(pixels, len(grid)))
    return np.array(measured), np.array(expected)


def projected_area_centroid(pixels: F64, n: int) -> F64:
    """The centroid of a projected square from an n x n grid of its points."""
    p = pixels.reshape(n, n, 2)
    d1, d2 = p[1:, 1:] - p[:-1, :-1], p[1:, :-1] - p[:-1, 1:]
    area = np.abs(d1[..., 0] * d2[..., 1] - d1[..., 1] * d2[..., 0])
    middle = (p[1:, 1:] + p[:-1, :-1] + p[1:, :-1] + p[:-1, 1:]) / 4
    return np.asarray((area[..., None] * middle).sum(axis=(0, 1)) / area.sum())


def test_a_still_camera_sees_every_dot_where_its_model_projects_it(room: Room) -> None:
    measured, expected = measured_and_expected(room, GLOBAL, STILL, 0.0, 1)
    error = np.linalg.norm(measured - expected, axis=1)
    assert len(error) > 60
    assert error.max() < 0.3
    assert np.abs((measured - expected).mean(axis=0)).max() < 0.03


def test_a_fisheye_sees_every_dot_where_its_model_projects_it_and_is_dark_beyond_80_degrees() -> (
    None
):
    wide = Camera(
        width_px=480, height_px=360, fx_px=170.0, fy_px=171.0, cx_px=241.0, cy_px=178.0,
        model="fisheye", k1=-0.02, k2=0.004,
    )  # fmt: skip
    with open_room(wide) as room:
        measured, expected = measured_and_expected(room, wide, STILL, 0.0, 1)
        maker = room.maker(wide, 1)
        picture = maker.expose(maker.radiance(STILL, 0.0, 0.0), 1e-3, 1.0, None)
    error = np.linalg.norm(measured - expected, axis=1)
    rays = wide.rays(expected)
    angle_deg = np.degrees(np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]))
    assert len(error) > 60 and angle_deg.max() > 65
    assert error.max() < 0.3
    grid = np.stack(np.meshgrid(np.arange(480), np.arange(360)), axis=-1).reshape(-1, 2)
    rays = wide.rays(grid)
    dark = (rays[:, 2] < np.cos(np.radians(80.1))).reshape(360, 480)
    assert dark.any() and (picture[dark] == 0).all() and (picture[~dark] > 0).mean() > 0.6


@pytest.mark.parametrize(("renders", "exposure_s"), [(2, 0.0), (3, 0.008)])
def test_a_moving_camera_sees_every_dot_at_the_time_of_its_row(
    room: Room, renders: int, exposure_s: float
) -> None:
    measured, expected = measured_and_expected(room, THESIS_CAMERA, FAST, exposure_s, renders)
    error = np.linalg.norm(measured - expected, axis=1)
    still = project_rolling(GLOBAL, FAST, 0.0, room.centres)
    rolled = project_rolling(THESIS_CAMERA, FAST, 0.0, room.centres)
    assert np.nanmax(np.linalg.norm(rolled - still, axis=1)) > 5  # the effect to get right
    assert len(error) > 60
    assert np.median(error) < 0.1
    assert np.quantile(error, 0.95) < 0.3


def test_rows_agree_with_a_render_for_each_row(room: Room) -> None:
    picture = room.maker(THESIS_CAMERA, 2).radiance(FAST, 0.0, 0.0)
    one = room.maker(GLOBAL, 1)
    offsets = row_offsets_s(THESIS_CAMERA)
    flat = one.radiance(FAST, 0.0, 0.0)
    rolled, skipped = [], []
    for row in range(5, 480, 30):
        truth = one.radiance(FAST, float(offsets[row]), 0.0)[row]
        # An edge that is a pixel off differs by its whole contrast.
        rolled.append(np.abs(picture[row] - truth).mean())
        skipped.append(np.abs(flat[row] - truth).mean())
    assert np.mean(rolled) < 0.1 * np.mean(skipped)
    # The remaining error as a shift: mean difference over mean gradient.
    gradient = np.abs(np.diff(flat[5::30], axis=1)).mean()
    assert np.mean(rolled) / gradient < 0.3


def test_exposure_smears_along_the_motion_and_leaves_the_middle(room: Room) -> None:
    turning = moving(np.zeros(3), np.array([1.0, 0.0, 0.0]))
    exposure_s = 0.016
    sharp, expected = measured_and_expected(room, GLOBAL, STILL, 0.0, 1)
    blurred, _ = measured_and_expected(room, GLOBAL, turning, exposure_s, 3)
    assert len(sharp) == len(blurred) == len(expected)
    assert np.median(np.abs(blurred - expected)) < 0.15
    maker = room.maker(GLOBAL, 2)
    still, smeared = (
        cv2.cvtColor(maker.radiance(m, 0.0, exposure_s), cv2.COLOR_RGB2GRAY)
        for m in (STILL, turning)
    )
    across = [np.abs(np.diff(image, axis=1)).max(axis=1).mean() for image in (still, smeared)]
    along = [np.abs(np.diff(image, axis=0)).max(axis=0).mean() for image in (still, smeared)]
    # About 8 px of smear: vertical edges fade, horizontal ones stay.
    assert across[1] < 0.35 * across[0]
    assert along[1] > 0.75 * along[0]


def test_noise_follows_shot_and_read_noise_and_grows_with_gain(room: Room) -> None:
    maker = room.maker(GLOBAL, 1)
    s = maker.sensor
    rng = np.random.default_rng(0)
    deviations = []
    for gain in (1.0, 8.0):
        exposure_s = 1e-3
        radiance = np.full((480, 640, 3), 0.18 / (s.sensitivity * exposure_s * gain), np.float32)
        noisy = maker.expose(radiance, exposure_s, gain, rng)[200:280, 280:360].astype(float)
        clean = maker.expose(radiance, exposure_s, gain, None)[200:280, 280:360].astype(float)
        assert abs(noisy.mean() - clean.mean()) < 1.0
        deviations.append(noisy.std())
    assert 0.5 < deviations[0] < 4
    assert deviations[1] / deviations[0] == pytest.approx(np.sqrt(8), rel=0.25)


def as_camera(room: Room, level: F64, gain: float, seed: int | None) -> tuple[F64, F64]:
    """A grey level (H, W, 3) as RGB pictures: a perfect sensor's and a camera's."""
    exposure_s = 1e-3
    pictures = []
    for processed in PROCESSINGS:
        pinhole = covering_pinhole(GLOBAL, room.supersampling)
        maker = FrameMaker(room.renderer, room.decoder, GLOBAL, pinhole, processed=processed)
        radiance = (level / (maker.sensor.sensitivity * exposure_s * gain)).astype(np.float32)
        rng = None if seed is None else np.random.default_rng(seed)
        pictures.append(maker.expose(radiance, exposure_s, gain, rng).astype(float))
    return pictures[0], pictures[1]


def test_a_cameras_processing_keeps_colours_and_sharpens_edges(room: Room) -> None:
    level = np.empty((480, 640, 3))
    level[:, :320], level[:, 320:] = (0.5, 0.2, 0.1), (0.05, 0.3, 0.6)
    perfect, processed = as_camera(room, level, 1.0, None)
    for side in (slice(260, 300), slice(340, 380)):
        colours = [p[220:260, side].mean(axis=(0, 1)) for p in (perfect, processed)]
        assert colours[1] == pytest.approx(colours[0], abs=3)
    level[:, :320], level[:, 320:] = 0.1, 0.4
    perfect, processed = as_camera(room, level, 1.0, None)
    across = processed[240, 300:340, 1]
    low, high = perfect[240, 300, 1], perfect[240, 339, 1]
    overshoot = max(across.max() - high, low - across.min()) / (high - low)
    assert 0.03 < overshoot < 0.2
    assert np.ptp(perfect[240, 300:340, 1]) <= high - low + 4  # but for the vignette


def test_a_cameras_processing_leaves_less_noise_in_larger_grains(room: Room) -> None:
    for gain in (1.0, 8.0):
        off = []
        for picture in as_camera(room, np.full((480, 640, 3), 0.18), gain, 1):
            grey = picture[200:280, 280:360] @ [0.299, 0.587, 0.114]
            off.append(grey - grey.mean())
        perfect, processed = off
        neighbours = [(d[:, 1:] * d[:, :-1]).mean() / d.var() for d in off]
        assert abs(neighbours[0]) < 0.1 and neighbours[1] > 0.3
        assert 0.3 < processed.std() / perfect.std() < 0.9


def test_darker_light_means_longer_exposure_first_and_gain_then() -> None:
    sensor = Sensor()
    settings = []
    for level in (3.0, 1.0, 0.1, 0.01):
        radiance = np.full((480, 640, 3), level, np.float32)
        settings.append(AutoExposure(sensor, radiance).settings)
    exposures, gains = zip(*settings, strict=True)
    assert list(exposures) == sorted(exposures)
    assert list(gains) == sorted(gains)
    assert gains[0] == 1.0
    assert exposures[-1] == sensor.exposure_limits_s[1]
    assert gains[-1] > 1.5


def test_auto_exposure_lags() -> None:
    sensor = Sensor()
    bright, dark = (np.full((480, 640, 3), level, np.float32) for level in (1.0, 0.5))
    control = AutoExposure(sensor, bright)
    before = np.prod(control.settings)
    control.update(dark, 1 / 30)
    soon = np.prod(control.settings)
    for _ in range(120):
        control.update(dark, 1 / 30)
    late = np.prod(control.settings)
    assert before < soon < late
    assert late / before == pytest.approx(2.0, rel=0.02)
    assert (soon / before) < 1.2
