"""From pictures of a 150° fisheye to a map and poses in it, as a user would do it; simulated."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hand_made import camera_file

from ground_station import cli
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera
from ground_station.geometry.trajectory import Trajectory, read_tum, write_tum
from ground_station.map import store

FISHEYE = Camera(
    width_px=320, height_px=240, fx_px=122.2, fy_px=122.5, cx_px=158.3, cy_px=121.0,
    model="fisheye", k1=-0.02, k2=0.004, k3=-0.001,
)  # fmt: skip
HALF_M = np.array([3.0, 2.5, 1.5])
"""Of the room, a box around the origin."""
TEXEL_M = 0.01


def textures(rng: np.random.Generator) -> list[np.ndarray]:
    """Of the six walls, with corners at several scales: +x, -x, +y, -y, +z, -z."""
    found = []
    for axis in (0, 0, 1, 1, 2, 2):
        a, b = (2 * HALF_M[k] / TEXEL_M for k in range(3) if k != axis)
        image = np.zeros((int(b), int(a)), np.float32)
        for size, weight in ((6, 0.5), (15, 0.7), (50, 1.0)):
            cells = rng.normal(size=(int(b) // size + 2, int(a) // size + 2)).astype(np.float32)
            image += weight * cv2.resize(cells, image.shape[::-1], interpolation=cv2.INTER_CUBIC)
        found.append(cv2.normalize(image, None, 20, 235, cv2.NORM_MINMAX))
    return found


def picture(camera: Camera, wTc: np.ndarray, walls: list[np.ndarray], rng) -> np.ndarray:
    """What a camera in the room sees, with noise; dark beyond 80° from its axis."""
    u, v = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
    rays_c = camera.rays(np.stack([u.ravel(), v.ravel()], axis=1))
    lit = rays_c[:, 2] > np.cos(np.radians(80))
    rays, at = rays_c @ wTc[:3, :3].T, wTc[:3, 3]
    rays[rays == 0] = 1e-12
    reach = (np.sign(rays) * HALF_M - at) / rays
    axis = reach.argmin(axis=1)
    hit = at + rays * reach.min(axis=1)[:, None]
    image = np.zeros(len(rays), np.float32)
    for wall, texture in enumerate(walls):
        k, sign = wall // 2, 1 - 2 * (wall % 2)
        mine = lit & (axis == k) & (np.sign(rays[:, k]) == sign)
        i, j = (m for m in range(3) if m != k)
        x, y = (
            ((hit[:, m] + HALF_M[m]) / TEXEL_M - 0.5).astype(np.float32).reshape(u.shape)
            for m in (i, j)
        )
        shown = cv2.remap(texture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        image[mine] = shown.ravel()[mine]
    image[lit] += rng.normal(0, 1.5, int(lit.sum()))
    return np.clip(image, 0, 255).astype(np.uint8).reshape(u.shape)


def around(count: int, radius_m: float, height_m: float, turn: float) -> np.ndarray:
    """A round through the room looking outwards: wTc (N, 4, 4)."""
    path = []
    for angle in np.linspace(0, 2 * np.pi, count, endpoint=False) + turn:
        z = np.array([np.cos(angle), np.sin(angle), 0.1 * np.sin(3 * angle)])
        z /= np.linalg.norm(z)
        x = np.cross(z, [0, 0, 1.0])
        x /= np.linalg.norm(x)
        at = [radius_m * np.cos(angle), radius_m * np.sin(angle), height_m * np.sin(2 * angle)]
        path.append(poses.pose(np.stack([x, np.cross(z, x), z], axis=1), at))
    return np.stack(path)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with pictures and truth of two rounds, the camera's file, and the map of one."""
    folder, rng = tmp_path_factory.mktemp("fisheye"), np.random.default_rng(8)
    walls = textures(rng)
    for name, path in (("map", around(18, 1.2, 0.15, 0.0)), ("fly", around(12, 1.0, -0.1, 0.08))):
        (folder / name).mkdir()
        for k, wTc in enumerate(path):
            cv2.imwrite(str(folder / name / f"{k:03d}.png"), picture(FISHEYE, wTc, walls, rng))
        times_ns = np.round(np.arange(len(path)) / 2 * 1e9).astype(np.int64)
        write_tum(folder / f"{name}.txt", Trajectory.from_poses(times_ns, path))
    camera_file(folder / "camera.toml", FISHEYE)
    blimp("map", "build", folder / "map", "--camera", folder / "camera.toml", "--rate-hz", 2,
          "--features", "rootsift", "--out", folder / "room")  # fmt: skip
    blimp("map", "register", folder / "room", "--trajectory", folder / "map.txt")
    return folder


def blimp(*arguments: object) -> None:
    assert cli.main([str(argument) for argument in arguments]) == 0


def test_the_map_is_whole_and_true_and_uses_nothing_of_the_rim(flown: Path) -> None:
    map_ = store.load(flown / "room")
    kf, truth = map_.keyframes, read_tum(flown / "map.txt")
    assert map_.info.camera == FISHEYE and len(kf) == 18
    off = np.linalg.norm(kf.wTc[:, :3, 3] - truth.wTc[:, :3, 3], axis=1)
    assert np.median(off) < 0.01 and off.max() < 0.03
    assert FISHEYE.uses(kf.pixel_px).all()
    angle = np.degrees(np.arctan(np.linalg.norm(FISHEYE.undistort(kf.pixel_px), axis=1)))
    assert (angle > 50).sum() > 500  # what a lens of 100° does not see
    lm = map_.landmarks.position_m
    inside = np.abs(lm) - HALF_M
    assert np.median(np.abs(inside.max(axis=1))) < 0.02  # on the walls


def test_the_map_localizes_another_flight_without_a_first_pose(flown: Path) -> None:
    blimp("localize", flown / "fly", "--map", flown / "room", "--rate-hz", 2, "--init", "none",
          "--out", flown / "est.txt", "--json", flown / "est.json")  # fmt: skip
    estimate, truth = read_tum(flown / "est.txt"), read_tum(flown / "fly.txt")
    assert len(estimate) >= 11
    rows = np.searchsorted(truth.time_ns, estimate.time_ns)
    apart = np.array([
        poses.log(poses.inverse(a) @ b)
        for a, b in zip(truth.wTc[rows], estimate.wTc, strict=True)
    ])  # fmt: skip
    assert np.linalg.norm(apart[:, 3:], axis=1).max() < 0.03
    assert np.degrees(np.linalg.norm(apart[:, :3], axis=1)).max() < 0.5
