"""Observations of known points (PAIRS.csv), and their triangulation with a model's own poses."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ground_station.arrays import F64, I64
from ground_station.errors import MapError
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera

_MOST_BYTES = 32 << 20
_LARGEST = 1e7
"""Of any number in such a table, metres or pixels: beyond, somebody mistook a column."""


def read_rows(
    path: str | Path, columns: Sequence[str], what: str
) -> list[tuple[str, dict[str, str | None]]]:
    """A table's rows, each with where it stands for messages ("FILE, `what` 3").

    Lines that are empty or begin with `#` are left out. Raises `MapError` with one line for a file
    that cannot be read, is not text or lacks one of the `columns`.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            data = file.read(_MOST_BYTES + 1)
        if len(data) > _MOST_BYTES:
            raise MapError(f"{path}: more than {_MOST_BYTES} bytes, which no such table has")
        text = data.decode("utf-8-sig")
    except OSError as error:
        raise MapError(f"{path}: {error.strerror or error}") from None
    except UnicodeDecodeError:
        raise MapError(f"{path}: not a text file") from None
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    reader = csv.DictReader(lines)
    try:
        missing = [name for name in columns if name not in (reader.fieldnames or ())]
        if missing:
            raise MapError(
                f"{path}: the column '{missing[0]}' is missing (needed: {','.join(columns)})"
            )
        return [(f"{path}, {what} {k}", row) for k, row in enumerate(reader, start=1)]
    except csv.Error as error:
        raise MapError(f"{path}: {error}") from None


def numbers(row: Mapping[str, str | None], names: Sequence[str], where: str) -> list[float]:
    """The numbers of a row in the columns `names`; raises `MapError` for what is none."""
    try:
        values = [float(row[name] or "") for name in names]
    except ValueError:
        raise MapError(f"{where}: numbers are needed in {', '.join(names)}") from None
    for name, value in zip(names, values, strict=True):
        if not math.isfinite(value):
            raise MapError(f"{where}: {name} is {value}; a number that is not finite is none")
        if abs(value) > _LARGEST:
            raise MapError(f"{where}: {name} is {value:g}; allowed: up to {_LARGEST:g}")
    return values


def word(row: Mapping[str, str | None], name: str, where: str) -> str:
    """The text of a row in the column `name`; raises `MapError` where it is empty."""
    text = (row[name] or "").strip()
    if not text:
        raise MapError(f"{where}: the column '{name}' is empty")
    return text


COLUMNS = ("point", "image", "u_px", "v_px", "x_m", "y_m", "z_m")
_SAME_POINT_M = 1e-6
_HUBER_PX = 2.0
_LEAST_PX = 0.1
"""No observation is better than a tenth of a pixel, however well a few of them happen to meet."""


@dataclass(frozen=True)
class PointObservations:
    """S observations of P known points.

    `points`, P names; `world_m` (P, 3); `point` (S,), an index into the points; `image`, S image
    names; `pixel_px` (S, 2), distorted pixels. Points that were measured as one thing, such as a
    tag's corners, share a number in `thing` (P,); without it each is one of its own.
    """

    points: list[str]
    world_m: F64
    point: I64
    image: list[str]
    pixel_px: F64
    thing: I64 | None = None

    @property
    def group(self) -> I64:
        """The number of the thing that each point belongs to, (P,)."""
        return np.arange(len(self.points)) if self.thing is None else self.thing


@dataclass(frozen=True)
class Triangulated:
    """A known point found again in the model's coordinates.

    `name`; `world_m` (3,); `position` (3,) and `covariance` (3, 3) for 1 px of noise, model units;
    `wTc` (S, 4, 4), the poses that saw it; `ray` (S, 2), on the plane z = 1; `error_px`, the RMS of
    its reprojection.
    """

    name: str
    world_m: F64
    position: F64
    covariance: F64
    wTc: F64
    ray: F64
    error_px: float


def read_pairs(path: str | Path) -> PointObservations:
    """Reads `point,image,u_px,v_px,x_m,y_m,z_m` lines; raises `MapError` naming the line.

    So it does for a point that is seen twice in one image, and for two points at one place: of two
    names for one thing, or two clicks on it, one is a mistake.
    """
    index: dict[str, int] = {}
    world: list[list[float]] = []
    point: list[int] = []
    image: list[str] = []
    pixels: list[list[float]] = []
    seen: set[tuple[str, str]] = set()
    for where, row in read_rows(path, COLUMNS, "observation"):
        u, v, *xyz = numbers(row, COLUMNS[2:], where)
        name, picture = word(row, "point", where), word(row, "image", where)
        if name not in index:
            index[name] = len(world)
            world.append(xyz)
        elif math.dist(world[index[name]], xyz) > _SAME_POINT_M:
            raise MapError(f"{where}: the point '{name}' was at {world[index[name]]} before")
        if (name, picture) in seen:
            raise MapError(f"{where}: the point '{name}' was seen in '{picture}' before")
        seen.add((name, picture))
        point.append(index[name])
        image.append(picture)
        pixels.append([u, v])
    if not point:
        raise MapError(f"{path}: it holds no observations")
    places: dict[tuple[float, ...], str] = {}
    for name, k in index.items():
        place = tuple(round(x / _SAME_POINT_M) for x in world[k])
        if place in places:
            raise MapError(
                f"{path}: the points '{places[place]}' and '{name}' are at the same place"
            )
        places[place] = name
    return PointObservations(
        points=list(index),
        world_m=np.array(world),
        point=np.array(point, dtype=np.int64),
        image=image,
        pixel_px=np.array(pixels),
    )


def triangulate_observations(
    observations: PointObservations, names: list[str], wTc: F64, camera: Camera
) -> tuple[list[Triangulated], list[str]]:
    """The points that at least two images of a model see, and a note for each that had to go.

    `names`, K images of the model, and their poses `wTc` (K, 4, 4). An image is known by its name,
    or by its name without folder and suffix where only one has that.
    """
    lookup = lookup_images(names)
    found: list[Triangulated] = []
    notes: list[str] = []
    rays = camera.undistort(observations.pixel_px)
    for p, name in enumerate(observations.points):
        mine = np.flatnonzero(observations.point == p)
        within = mine[np.isfinite(rays[mine]).all(axis=1)]
        if len(within) < len(mine):
            notes.append(
                f"point '{name}': {len(mine) - len(within)} of its {len(mine)} observations are "
                "too near the rim of a fisheye's picture to be used: click it nearer to the middle"
            )
        mine = within
        images = [observations.image[s] for s in mine]
        rows = [lookup.get(image, lookup.get(Path(image).stem)) for image in images]
        known = [(s, k) for s, k in zip(mine, rows, strict=True) if k is not None]
        if len({k for _, k in known}) < 2:
            notes.append(
                f"point '{name}' left out: {len(known)} of its {len(mine)} images are in the map"
            )
            continue
        T, ray = wTc[[k for _, k in known]], rays[[s for s, _ in known]]
        position = triangulate(T, ray, camera)
        if position is None:
            notes.append(
                f"point '{name}' left out: its observations do not meet in front of the cameras"
            )
            continue
        residual, J = reproject(position, T, ray, camera)
        information = np.einsum("ski,skj->ij", J, J)
        found.append(
            Triangulated(
                name=name,
                world_m=observations.world_m[p],
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
    c = poses.in_each(wTc, X)
    z = np.where(c[:, 2:] > 0, c[:, 2:], np.nan)
    xy = c[:, :2] / z
    J = np.zeros((len(wTc), 2, 3))
    J[:, 0, 0] = J[:, 1, 1] = 1.0 / z[:, 0]
    J[:, :, 2] = -xy / z
    J = J * f[:, None] @ np.swapaxes(wTc[:, :3, :3], 1, 2)
    return (rays - xy) * f, J


def sigma_px(points: Sequence[Triangulated]) -> float:
    """The deviation of an observation's coordinate, pixels: what the triangulation leaves."""
    squares = sum(len(point.ray) * point.error_px**2 for point in points)
    freedom = sum(2 * len(point.ray) - 3 for point in points)
    return max(float(np.sqrt(squares / max(freedom, 1))), _LEAST_PX)


def lookup_images(names: list[str]) -> dict[str, int]:
    """Where an image stands in `names`, by its name and by its stem where only one has that."""
    stems: dict[str, list[int]] = {}
    for k, name in enumerate(names):
        stems.setdefault(Path(name).stem, []).append(k)
    result = {stem: k[0] for stem, k in stems.items() if len(k) == 1}
    return result | {name: k for k, name in enumerate(names)}
