"""Observations of surveyed points: where a person would click them in a recording's pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ground_station.arrays import F64, Bools
from ground_station.files import write_text
from ground_station.geometry import poses
from ground_station.geometry.alignment import spread_out
from ground_station.geometry.camera import Camera
from ground_station.recording.video import frame_name
from ground_station.simulator.motion import Motion
from ground_station.simulator.rendering import Pinhole, SceneRenderer
from ground_station.simulator.scene import KnownPoint, SimulatorError

_CLICK_NOISE_PX = 0.3
_EDGE_PX = 20.0
_RANGE_M = (1.0, 12.0)
_FLOW_LIMIT_PX_S = 90.0  # over half a readout of 10 ms: within a pixel of a global shutter
_MIN_FACING = 0.3  # cosine of the angle between view and normal
_MIN_PARALLAX_DEG = 13.0
_MOST_POINTS, _MOST_FRAMES, _APART_M = 18, 5, 0.2


@dataclass(frozen=True)
class PointObservation:
    """A known point seen in a frame, distorted pixels."""

    point: KnownPoint
    frame: int
    pixel: tuple[float, float]


def project_rolling(camera: Camera, motion: Motion, time_s: float, points_w: npt.ArrayLike) -> F64:
    """Distorted pixels (N, 2) of world points (N, 3) in the frame whose middle row is at `time_s`.

    Each point is seen by the row it falls on, found by iteration; NaN behind the camera.
    """
    points = np.asarray(points_w, dtype=np.float64).reshape(-1, 3)
    per_row_s = camera.readout_s / (camera.height_px - 1)
    middle = (camera.height_px - 1) / 2
    row = np.full(len(points), middle)
    pixels = np.full((len(points), 2), np.nan)
    for _ in range(6):
        times = time_s + (np.nan_to_num(row, nan=middle) - middle) * per_row_s
        cTw = poses.inverse(motion.wTc(times))
        local = np.einsum("nij,nj->ni", cTw[:, :3, :3], points) + cTw[:, :3, 3]
        pixels = camera.project(local)
        row = np.clip(pixels[:, 1], -middle, 3 * middle)
    return pixels


def _visible(
    renderer: SceneRenderer, pinhole: Pinhole, wTc: F64, points: Sequence[KnownPoint]
) -> Bools:
    """Which points nothing hides, by depth at the pose of the middle row."""
    position = np.array([p.position_m for p in points])
    normal = np.array([p.normal for p in points])
    local = poses.transform(poses.inverse(wTc), position)
    z = np.where(local[:, 2] > 0.1, local[:, 2], np.nan)
    to_camera = wTc[:3, 3] - position
    distance = np.linalg.norm(to_camera, axis=1)
    facing = (to_camera * normal).sum(axis=1) / distance
    cx, cy = pinhole.centre_px
    u = np.nan_to_num(pinhole.focal_px * local[:, 0] / z + cx, nan=-9).round().astype(int)
    v = np.nan_to_num(pinhole.focal_px * local[:, 1] / z + cy, nan=-9).round().astype(int)
    ok = (u > 2) & (v > 2) & (u < pinhole.width_px - 3) & (v < pinhole.height_px - 3)
    ok &= (facing > _MIN_FACING) & (distance > _RANGE_M[0]) & (distance < _RANGE_M[1])
    if ok.any():
        depth = renderer.depth(wTc, pinhole)
        for i in np.flatnonzero(ok):
            patch = depth[v[i] - 2 : v[i] + 3, u[i] - 2 : u[i] + 3]
            ok[i] = patch.min() > z[i] - 0.08
    return ok


def choose_observations(
    renderer: SceneRenderer,
    pinhole: Pinhole,
    camera: Camera,
    motion: Motion,
    times_s: F64,
    points: Sequence[KnownPoint],
    rng: np.random.Generator,
) -> list[PointObservation]:
    """Up to `_MOST_POINTS` points spread over the hall, each in 3 to `_MOST_FRAMES` distant frames.

    Raises `SimulatorError` when fewer than 4 points are seen often enough to register a map.
    """
    position = np.array([p.position_m for p in points])
    seen: list[list[tuple[int, F64, F64]]] = [[] for _ in points]
    stride = max(1, len(times_s) // 150)
    half_flow_s = 0.005
    for frame in range(0, len(times_s), stride):
        t = float(times_s[frame])
        renderer.at(t)
        wTc = motion.wTc([t])[0]
        pixels = project_rolling(camera, motion, t, position)
        later = project_rolling(camera, motion, t + half_flow_s, position)
        flow = np.linalg.norm(later - pixels, axis=1) / half_flow_s
        low = (pixels > _EDGE_PX).all(axis=1)
        high = (pixels < [camera.width_px - 1 - _EDGE_PX, camera.height_px - 1 - _EDGE_PX]).all(
            axis=1
        )
        candidates = low & high & (flow < _FLOW_LIMIT_PX_S) & camera.uses(pixels)
        if not candidates.any():
            continue
        for i in np.flatnonzero(candidates & _visible(renderer, pinhole, wTc, points)).tolist():
            seen[i].append((frame, pixels[i], wTc[:3, 3]))
    chosen: dict[int, list[tuple[int, F64, F64]]] = {}
    for i, observations in enumerate(seen):
        if len(observations) < 3:
            continue
        centres = np.array([centre for _, _, centre in observations])
        picked = [observations[k] for k in spread_out(centres, _MOST_FRAMES, _APART_M)]
        if len(picked) >= 3 and _parallax_deg(picked, position[i]) >= _MIN_PARALLAX_DEG:
            chosen[i] = picked
    if len(chosen) < 4:
        raise SimulatorError(
            f"only {len(chosen)} known points are seen in three far-apart frames; 4 are needed:"
            " fly longer"
        )
    seen_enough = list(chosen)
    scaled = position[seen_enough] * [1, 1, 2]  # heights count double, halls being flat
    result = []
    for index in sorted(seen_enough[k] for k in spread_out(scaled, _MOST_POINTS)):
        for frame, pixel, _ in sorted(chosen[index], key=lambda s: s[0]):
            u, v = pixel + _CLICK_NOISE_PX * rng.standard_normal(2)
            result.append(PointObservation(points[index], frame, (float(u), float(v))))
    return result


def _parallax_deg(observations: list[tuple[int, F64, F64]], point: F64) -> float:
    rays = np.array([s[2] - point for s in observations])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return float(np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1, 1))))


def write_pairs(path: Path, observations: Sequence[PointObservation]) -> None:
    """Writes PAIRS.csv, beside and renamed."""
    lines = ["point,image,u_px,v_px,x_m,y_m,z_m"]
    for s in observations:
        x, y, z = s.point.position_m
        u, v = s.pixel
        lines.append(
            f"{s.point.name},{frame_name(s.frame)},{u:.2f},{v:.2f},{x:.4f},{y:.4f},{z:.4f}"
        )
    write_text(path, "\n".join(lines) + "\n")
