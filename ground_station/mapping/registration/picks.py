"""Picks: places of the map's top view and where they are on the floor plan. PICKS.toml."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from ground_station.arrays import F64, I64
from ground_station.errors import GeometryError, MapError
from ground_station.files import write_text
from ground_station.geometry.alignment import align
from ground_station.map.store import Landmarks
from ground_station.mapping.registration.adjustment import Upright
from ground_station.mapping.registration.plan import PlanScale
from ground_station.mapping.registration.registration import MIN_POINTS, check_spread
from pi_firmware.wire import config
from pi_firmware.wire.errors import ConfigError

FILE = "PICKS.toml"
DRAFT = "PICKS.draft.toml"
"""Picks that were made and not saved: a browser or a machine that goes takes none with it."""
FORMAT = 1
MOST_PICKS = 200
MOST_LANDMARKS = 300
_LONGEST_NAME = 40
MIN_WIDTH = 0.05
"""Second over first extent of picks: a person's clicks on one wall are not on an exact line."""
_SAME_PX = 1.0
_SAME_MAP = 0.01
"""How far picks may have moved against each other since they were made, in their extent."""


@dataclass(frozen=True)
class Pick:
    """A cluster of landmarks and its place on the plan.

    `landmarks`, ids; `place` (3,), where it was clicked, and `offset` (3,), how far that is from
    their centroid, map units; `plan_px` (2,), pixels of the plan.
    """

    name: str
    landmarks: I64
    place: F64
    plan_px: F64
    offset: F64 = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True)
class Picks:
    """Picks, the plan's scale, and the vertical, all in the map's coordinates as they were.

    `covariance` (N, 3, 3) is of the clusters' centroids, map units; only `at_present` knows it.
    """

    picks: list[Pick]
    scale: PlanScale
    upright: Upright
    plan: str = ""
    plan_sha256: str = ""
    covariance: F64 = field(default_factory=lambda: np.zeros((0, 3, 3)))


@dataclass(frozen=True)
class _Pick:
    name: str
    landmarks: list[int]
    place: list[float]
    plan_px: list[float]
    offset: list[float] = config.key([0.0, 0.0, 0.0], "of the place from the landmarks' middle")


@dataclass(frozen=True)
class _Plan:
    image: str
    sha256: str = config.key("", "of its pixels")
    height_px: int = config.key(0, "rows", unit="px", low=1, high=1 << 20)
    resolution_m: float = config.key(0.0, "of a pixel", unit="m", low=1e-4, high=10.0)
    origin: list[float] = config.key([0.0, 0.0, 0.0], "lower left corner: x, y, yaw")


@dataclass(frozen=True)
class _Up:
    direction: list[float]
    sigma_deg: float = config.key(0.3, "about each horizontal axis", unit="deg", low=1e-3, high=45)
    level: float = config.key(0.0, "a horizontal plane's, along it", low=-1e9, high=1e9)
    level_sigma: float = config.key(0.0, "the same", low=0.0, high=1e9)
    height_m: float = config.key(0.0, "and its height", unit="m", low=-1e4, high=1e4)


@dataclass(frozen=True)
class _File:
    format: int
    plan: _Plan
    up: _Up
    pick: list[Any]


def read_picks(path: str | Path) -> Picks:
    """Reads PICKS.toml; raises `MapError` with one line naming what is wrong."""
    path = Path(path)
    try:
        document = config.read(path)
        for table in ("plan", "up"):
            if not isinstance(document.get(table), dict):
                raise MapError(f"{path}: the table '{table}' is missing")
        if "resolution_m" not in document["plan"]:
            raise MapError(f"{path}: the floor plan has no scale (plan.resolution_m)")
        if "height_px" not in document["plan"]:
            raise MapError(f"{path}: the key 'plan.height_px' is missing")
        file = config.from_mapping(document, _File, where=str(path))
        if file.format != FORMAT:
            raise MapError(f"{path}: format {file.format}; this program reads {FORMAT}")
        if len(file.pick) > MOST_PICKS:
            raise MapError(f"{path}: {len(file.pick)} picks; at most {MOST_PICKS}")
        picks = [_pick(item, f"{path}, pick {k}") for k, item in enumerate(file.pick, 1)]
        names = [pick.name for pick in picks]
        for k, name in enumerate(names):
            if name in names[:k]:
                raise MapError(f"{path}: there are two picks with the name '{name:.40}'")
        direction = np.array(_vector(file.up.direction, 3, f"{path}: up.direction"))
        length = float(np.linalg.norm(direction))
        if not abs(length - 1) < 1e-3:
            raise MapError(f"{path}: up.direction has the length {length:g}; allowed: 1")
        x, y, yaw = _vector(file.plan.origin, 3, f"{path}: plan.origin")
        return Picks(
            picks,
            PlanScale(file.plan.height_px, file.plan.resolution_m, (x, y, yaw)),
            Upright(
                direction / length,
                float(np.radians(file.up.sigma_deg)),
                file.up.level,
                file.up.level_sigma,
                file.up.height_m,
            ),
            file.plan.image,
            file.plan.sha256,
        )
    except ConfigError as error:
        raise MapError(str(error)) from None


def write_picks(path: str | Path, picks: Picks) -> None:
    """Writes PICKS.toml, beside and renamed."""
    up, scale = picks.upright, picks.scale
    document = {
        "format": FORMAT,
        "plan": {
            "image": picks.plan,
            "sha256": picks.plan_sha256,
            "height_px": scale.height_px,
            "resolution_m": scale.resolution_m,
            "origin": list(scale.origin),
        },
        "up": {
            "direction": up.direction.tolist(),
            "sigma_deg": float(np.degrees(up.sigma_rad)),
            "level": up.level,
            "level_sigma": up.sigma_level,
            "height_m": up.height_m,
        },
        "pick": [
            {
                "name": pick.name,
                "landmarks": pick.landmarks.tolist(),
                "place": pick.place.tolist(),
                "plan_px": pick.plan_px.tolist(),
                "offset": pick.offset.tolist(),
            }
            for pick in picks.picks
        ],
    }
    write_text(path, tomli_w.dumps(document))


def check_picks(picks: Picks) -> None:
    """Raises `MapError` where picks are too few, the same twice, or on one line."""
    if len(picks.picks) < MIN_POINTS:
        raise MapError(f"registration: {len(picks.picks)} picks; at least {MIN_POINTS} are needed")
    place = np.array([pick.place for pick in picks.picks])
    pixel = np.array([pick.plan_px for pick in picks.picks])
    extent = float(np.linalg.norm(np.ptp(place, axis=0)))
    for k, pick in enumerate(picks.picks):
        for j, other in enumerate(picks.picks[:k]):
            in_map = np.linalg.norm(place[k] - place[j]) <= 1e-6 * extent
            on_plan = np.linalg.norm(pixel[k] - pixel[j]) < _SAME_PX
            if in_map or on_plan:
                where = "in the map" if in_map else "on the plan"
                raise MapError(
                    f"registration: the picks '{other.name}' and '{pick.name}' are the same place "
                    f"{where}"
                )
    check_spread(picks.scale.to_world(pixel), "picks on the plan", MIN_WIDTH)
    up = picks.upright.direction
    check_spread(place - np.outer(place @ up, up), "picks in the map", MIN_WIDTH)


def unmoved(picks: Picks, landmarks: Landmarks) -> bool:
    """Whether the map is as it was when the picks were made, however few of them there are."""
    for pick in picks.picks:
        found = landmarks.position_m[np.isin(landmarks.id, pick.landmarks)]
        if len(found) != len(pick.landmarks) or not np.allclose(
            found.mean(axis=0) + pick.offset, pick.place
        ):
            return False
    return True


def at_present(picks: Picks, landmarks: Landmarks) -> Picks:
    """The picks in the coordinates that the map has now; they may have been made before it moved.

    The landmarks are known by their ids, so their present centroids tell the similarity that the
    map went through since, by which the vertical follows. Raises `MapError` where it is another
    map: landmarks that are not there, or places that moved against each other.
    """
    check_picks(picks)
    row = {int(number): k for k, number in enumerate(landmarks.id.tolist())}
    middle: list[F64] = []
    scatter: list[F64] = []
    for pick in picks.picks:
        rows = [row[i] for i in pick.landmarks.tolist() if i in row]
        if not rows:
            raise MapError(
                f"registration: none of the landmarks of pick '{pick.name}' is in this map; it was "
                "made in another one"
            )
        found = landmarks.position_m[rows]
        middle.append(found.mean(axis=0))
        scatter.append(
            np.cov(found.T, bias=True) / len(rows) if len(rows) > 1 else np.zeros((3, 3))
        )
    before = np.array([pick.place - pick.offset for pick in picks.picks])
    after = np.array(middle)
    try:
        went = align(before, after, True)
    except GeometryError:
        raise MapError("registration: the picks lie on one line of this map") from None
    off = np.linalg.norm(went.apply(before) - after, axis=1)
    extent = float(np.linalg.norm(np.ptp(after, axis=0)))
    if not off.max() <= _SAME_MAP * extent:
        worst = picks.picks[int(np.argmax(off))].name
        raise MapError(
            f"registration: pick '{worst}' is {100 * off.max() / extent:.1f} % of the picks' extent"
            f" off where it was made; allowed: {100 * _SAME_MAP:g} %: it was another map"
        )
    moved = [went.scale * went.rotation @ pick.offset for pick in picks.picks]
    now = [
        replace(pick, place=place + offset, offset=offset)
        for pick, place, offset in zip(picks.picks, middle, moved, strict=True)
    ]
    up = picks.upright
    direction = went.rotation @ up.direction
    upright = replace(
        up,
        direction=direction,
        level=went.scale * up.level + float(direction @ went.translation),
        sigma_level=went.scale * up.sigma_level,
    )
    return replace(picks, picks=now, upright=upright, covariance=np.array(scatter))


def _pick(item: Any, where: str) -> Pick:
    if not isinstance(item, dict):
        raise MapError(f"{where}: must be a table")
    read = config.from_mapping(item, _Pick, where=where)
    if not 1 <= len(read.name) <= _LONGEST_NAME:
        raise MapError(
            f"{where}: its name has {len(read.name)} letters; allowed: 1 to {_LONGEST_NAME}"
        )
    if not 1 <= len(read.landmarks) <= MOST_LANDMARKS:
        raise MapError(f"{where}: {len(read.landmarks)} landmarks; allowed: 1 to {MOST_LANDMARKS}")
    if not all(0 <= number < 1 << 63 for number in read.landmarks):
        raise MapError(f"{where}: a landmark's number is not one")
    return Pick(
        read.name,
        np.array(read.landmarks, np.int64),
        np.array(_vector(read.place, 3, f"{where}: place")),
        np.array(_vector(read.plan_px, 2, f"{where}: plan_px")),
        np.array(_vector(read.offset, 3, f"{where}: offset")),
    )


def _vector(values: list[float], length: int, what: str) -> list[float]:
    if len(values) != length:
        raise MapError(f"{what} has {len(values)} numbers; allowed: {length}")
    if not all(abs(value) < 1e9 for value in values):
        raise MapError(f"{what} is {values}; allowed: below 1e9")
    return values
