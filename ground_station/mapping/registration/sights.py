"""Sights of known points (PAIRS.csv) and their triangulation with a model's own poses."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ground_station.errors import MapError
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]

COLUMNS = ("point", "image", "u_px", "v_px", "x_m", "y_m", "z_m")
_SAME_POINT_M = 1e-6
_HUBER_PX = 2.0


@dataclass(frozen=True)
class Sights:
    """S sights of P known points.

    `points`, P names; `world_m` (P, 3); `point` (S,), an index into the points; `image`, S image
    names; `pixel_px` (S, 2), distorted pixels.
    """

    points: list[str]
    world_m: F64
    point: I64
    image: list[str]
    pixel_px: F64


@dataclass(frozen=True)
class Triangulated:
    """A known point found again in the model's coordinates.

    `name`; `world_m` (3,); `position` (3,) and `covariance` (3, 3) for 1 px of noise, model units;
    `wTc` (S, 4, 4), the poses of its sights; `ray` (S, 2), on the plane z = 1; `error_px`, the RMS
    of its sights' reprojection.
    """

    name: str
    world_m: F64
    position: F64
    covariance: F64
    wTc: F64
    ray: F64
    error_px: float


def read_pairs(path: str | Path) -> Sights:
    """Reads `point,image,u_px,v_px,x_m,y_m,z_m` lines; raises `MapError` naming the line."""
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise MapError(f"{path}: {error.strerror or error}") from None
    except UnicodeDecodeError:
        raise MapError(f"{path}: not a text file") from None
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    reader = csv.DictReader(lines)
    missing = [name for name in COLUMNS if name not in (reader.fieldnames or ())]
    if missing:
        raise MapError(
            f"{path}: the column '{missing[0]}' is missing (needed: {','.join(COLUMNS)})"
        )
    index: dict[str, int] = {}
    world: list[list[float]] = []
    point: list[int] = []
    image: list[str] = []
    pixels: list[list[float]] = []
    try:
        for number, row in enumerate(reader, start=1):
            where = f"{path}, sight {number}"
            try:
                u, v, *xyz = (float(row[name]) for name in COLUMNS[2:])
            except (TypeError, ValueError):
                raise MapError(f"{where}: five numbers are needed in {COLUMNS[2:]}") from None
            if not all(math.isfinite(value) for value in (u, v, *xyz)):
                raise MapError(f"{where}: a number is not finite")
            name = row["point"].strip()
            if name not in index:
                index[name] = len(world)
                world.append(xyz)
            elif math.dist(world[index[name]], xyz) > _SAME_POINT_M:
                raise MapError(f"{where}: the point '{name}' was at {world[index[name]]} before")
            point.append(index[name])
            image.append(row["image"].strip())
            pixels.append([u, v])
    except csv.Error as error:
        raise MapError(f"{path}: {error}") from None
    if not point:
        raise MapError(f"{path}: it holds no sights")
    return Sights(
        points=list(index),
        world_m=np.array(world),
        point=np.array(point, dtype=np.int64),
        image=image,
        pixel_px=np.array(pixels),
    )


def triangulate_sights(
    sights: Sights, names: list[str], wTc: F64, camera: Camera
) -> tuple[list[Triangulated], list[str]]:
    """The points that at least two images of a model see, and a note for each that had to go.

    `names`, K images of the model, and their poses `wTc` (K, 4, 4). An image is known by its name,
    or by its name without folder and suffix where only one has that.
    """
    lookup = _lookup(names)
    found: list[Triangulated] = []
    notes: list[str] = []
    rays = camera.undistort(sights.pixel_px)
    for p, name in enumerate(sights.points):
        mine = np.flatnonzero(sights.point == p)
        known = [(s, lookup[key]) for s in mine if (key := _key(sights.image[s], lookup))]
        if len({k for _, k in known}) < 2:
            notes.append(
                f"point '{name}' left out: {len(known)} of its {len(mine)} images are in the map"
            )
            continue
        T, ray = wTc[[k for _, k in known]], rays[[s for s, _ in known]]
        position = triangulate(T, ray, camera)
        if position is None:
            notes.append(f"point '{name}' left out: its sights do not meet in front of the cameras")
            continue
        residual, J = reproject(position, T, ray, camera)
        information = np.einsum("ski,skj->ij", J, J)
        found.append(
            Triangulated(
                name=name,
                world_m=sights.world_m[p],
                position=position,
                covariance=np.linalg.pinv(information),
                wTc=T,
                ray=ray,
                error_px=float(np.sqrt(np.mean(np.sum(residual**2, axis=1)))),
            )
        )
    return found, notes


def triangulate(wTc: F64, rays: F64, camera: Camera) -> F64 | None:
    """The point (3,) that S cameras `wTc` (S, 4, 4) see on `rays` (S, 2); None when behind one.

    Linear first (Hartley and Zisserman 2004, section 12.2), then Gauss–Newton on the pixels with
    Huber weights.
    """
    P = poses.inverse(wTc)[:, :3]
    A = (rays[:, :, None] * P[:, 2:3] - P[:, :2]).reshape(-1, 4)
    # Columns of a like size, so that the smallest singular value means something far from 0.
    homogeneous = np.linalg.svd(A)[2][-1]
    if abs(homogeneous[3]) < 1e-12:
        return None
    X = homogeneous[:3] / homogeneous[3]
    for _ in range(20):
        residual, J = reproject(X, wTc, rays, camera)
        if not np.isfinite(residual).all():
            return None
        norm = np.linalg.norm(residual, axis=1)
        weight = np.minimum(1.0, _HUBER_PX / np.maximum(norm, 1e-12))
        H = np.einsum("s,ski,skj->ij", weight, J, J)
        step = np.linalg.lstsq(H, np.einsum("s,ski,sk->i", weight, J, residual), rcond=None)[0]
        X = X + step
        if np.linalg.norm(step) < 1e-10 * max(1.0, float(np.linalg.norm(X))):
            break
    residual, _ = reproject(X, wTc, rays, camera)
    return X if np.isfinite(residual).all() else None


def reproject(X: F64, wTc: F64, rays: F64, camera: Camera) -> tuple[F64, F64]:
    """Residuals (S, 2), undistorted pixels, measured − projected, and d projected / d X (S, 2, 3).

    Points at or behind a camera give NaN.
    """
    f = np.array([camera.fx_px, camera.fy_px])
    R = wTc[:, :3, :3]
    c = np.einsum("sji,sj->si", R, X - wTc[:, :3, 3])
    z = np.where(c[:, 2:] > 0, c[:, 2:], np.nan)
    xy = c[:, :2] / z
    J = np.zeros((len(wTc), 2, 3))
    J[:, 0, 0] = J[:, 1, 1] = 1.0 / z[:, 0]
    J[:, :, 2] = -xy / z
    J = J * f[:, None] @ np.swapaxes(R, 1, 2)
    return (rays - xy) * f, J


def _lookup(names: list[str]) -> dict[str, int]:
    stems: dict[str, list[int]] = {}
    for k, name in enumerate(names):
        stems.setdefault(Path(name).stem, []).append(k)
    result = {stem: k[0] for stem, k in stems.items() if len(k) == 1}
    return result | {name: k for k, name in enumerate(names)}


def _key(image: str, lookup: dict[str, int]) -> str | None:
    return next((key for key in (image, Path(image).stem) if key in lookup), None)
