"""AprilTags of known place as known points: TAGS.toml, and where the map's frames show them."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ground_station.arrays import F64, U8
from ground_station.errors import MapError
from ground_station.geometry.camera import Camera
from ground_station.map.store import Map
from ground_station.mapping.registration.observations import (
    PointObservations,
    triangulate_observations,
)
from ground_station.recording.frames import Frame
from pi_firmware.wire import config
from pi_firmware.wire.errors import ConfigError

FAMILIES = {
    "16h5": cv2.aruco.DICT_APRILTAG_16h5,
    "25h9": cv2.aruco.DICT_APRILTAG_25h9,
    "36h11": cv2.aruco.DICT_APRILTAG_36h11,
}
"""Olson, "AprilTag: a robust and flexible visual fiducial system", ICRA 2011."""

_MOST_TAGS = 1000
_LARGEST_M = 1e6
_FLAT = 0.02
"""Share of the side by which four corners may differ from a flat square of the size that is told:
a ruler's error on a printed tag."""
_CONTRADICTION_PX = 5.0
_CORNERS = ("top left", "top right", "bottom right", "bottom left")


@dataclass(frozen=True)
class _Tag:
    id: int = config.key(0, "number in the family", low=0, high=10_000)
    centre_m: list[float] = config.key([], "in the world")
    facing_deg: float | None = config.key(
        None, "heading into which an upright tag on a wall looks, from x towards y", unit="deg",
        low=-360, high=360,
    )  # fmt: skip
    corners_m: list[list[float]] = config.key([], "top left, then clockwise, as it is looked at")


@dataclass(frozen=True)
class _File:
    family: str = config.key("36h11", "of the tags", choices=list(FAMILIES))
    size_m: float = config.key(0.16, "side of the black square", unit="m", low=0.005, high=10.0)
    turn_deg: int = config.key(
        0, "how far the tags are printed turned, clockwise", unit="deg", choices=[0, 90, 180, 270]
    )
    tag: list[Any] = field(default_factory=list)


@dataclass(frozen=True)
class Tags:
    """Tags of one family: for each id its known points (1, 3) or (4, 3), metres, in the world.

    One is the centre; four are the corners of the black square from the top left, clockwise for who
    looks at it. `turn` is how many quarter turns clockwise the print is turned.
    """

    family: str
    places: dict[int, F64]
    turn: int = 0


@dataclass(frozen=True)
class Found:
    """PointObservations of the tags' known points in the map's frames, and lines for a person."""

    observations: PointObservations
    notes: list[str]


def read_tags(path: str | Path) -> Tags:
    """Reads TAGS.toml; raises `MapError` with one line naming what is wrong."""
    path = Path(path)
    try:
        document = config.read(path)
        for name in ("family", "size_m"):
            if name not in document:
                raise MapError(f"{path}: the key '{name}' is missing")
        file = config.from_mapping(document, _File, where=str(path))
        if not 1 <= len(file.tag) <= _MOST_TAGS:
            raise MapError(f"{path}: {len(file.tag)} tags; allowed: 1 to {_MOST_TAGS}")
        places: dict[int, F64] = {}
        for k, item in enumerate(file.tag, 1):
            where = f"{path}, tag {k}"
            if not isinstance(item, dict) or "id" not in item:
                raise MapError(f"{where}: needs an id, and centre_m or corners_m")
            tag = config.from_mapping(item, _Tag, where=where)
            known = cv2.aruco.getPredefinedDictionary(FAMILIES[file.family]).bytesList.shape[0]
            if tag.id >= known:
                raise MapError(f"{where}: id is {tag.id}; {file.family} has 0 to {known - 1}")
            if tag.id in places:
                raise MapError(f"{where}: the id {tag.id} is there twice")
            places[tag.id] = _places(tag, file.size_m, where)
    except ConfigError as error:
        raise MapError(str(error)) from None
    return Tags(file.family, places, file.turn_deg // 90)


def _places(tag: _Tag, size_m: float, where: str) -> F64:
    if bool(tag.centre_m) == bool(tag.corners_m):
        raise MapError(f"{where}: needs either centre_m or corners_m")
    rows = tag.corners_m or [tag.centre_m]
    if len(rows) not in (1, 4) or any(len(row) != 3 for row in rows):
        raise MapError(f"{where}: centre_m has three numbers, corners_m four times three")
    places = np.array(rows)
    if not np.abs(places).max() < _LARGEST_M:
        raise MapError(f"{where}: a coordinate is above {_LARGEST_M:g} m")
    if len(places) == 4:
        if tag.facing_deg is not None:
            raise MapError(f"{where}: facing_deg goes with centre_m; corners say it themselves")
        sides = np.linalg.norm(np.roll(places, -1, axis=0) - places, axis=1)
        diagonals = np.linalg.norm(places[2:] - places[:2], axis=1) / math.sqrt(2)
        off = np.abs(np.concatenate([sides, diagonals]) / size_m - 1)
        if off.max() > _FLAT:
            raise MapError(
                f"{where}: its corners are no square of {size_m:g} m: a side or diagonal is "
                f"{100 * off.max():.1f} % off; allowed: {100 * _FLAT:g} %"
            )
        return places
    if tag.facing_deg is None:
        return places
    facing = math.radians(tag.facing_deg)
    # Who looks at the tag looks against where it faces: right is facing x up, seen from the front.
    right = np.array([-math.sin(facing), math.cos(facing), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    half = size_m / 2
    return places + half * np.array([-right + up, right + up, right - up, -right - up])


def detect(image: U8, family: str) -> list[tuple[int, F64]]:
    """Tags in a grey image (H, W): id and corners (4, 2), pixels, from the top left, clockwise.

    The top left is that of AprilTag's own images, which are what people print.
    Corners are refined to parts of a pixel on the picture as it is: a lens bends a line of a few
    pixels too little to matter.
    """
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    dictionary = cv2.aruco.getPredefinedDictionary(FAMILIES[family])
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(image)
    if ids is None:
        return []
    # OpenCV 4 has them half a turn off AprilTag's own.
    return [
        (int(number), np.roll(np.asarray(places, np.float64).reshape(4, 2), 2, axis=0))
        for number, places in zip(np.ravel(ids), corners, strict=True)
    ]


def find_tags(map_: Map, tags: Tags, frames: Iterable[Frame], stems: Iterable[str] = ()) -> Found:
    """The tags as seen in those frames that the map was built from, which have its names.

    `stems` are names of inputs that may stand before the frames', as in a map of several. A tag
    that is seen in one frame only, twice in one frame, or at two places, is left out with a note.
    Raises `MapError` where no frame is the map's, the size differs, or nothing is found.
    """
    camera, names = map_.info.camera, set(map_.keyframes.names)
    prefixes = ["", *(f"{stem}/" for stem in stems)]
    seen: dict[int, dict[str, F64]] = defaultdict(dict)
    twice: set[int] = set()
    looked, count, first = 0, 0, ""
    for frame in frames:
        count, first = count + 1, first or frame.name
        name = next((p + frame.name for p in prefixes if p + frame.name in names), None)
        if name is None:
            continue
        height, width = frame.image.shape
        if (width, height) != (camera.width_px, camera.height_px):
            raise MapError(
                f"frame '{frame.name}' has {width}x{height} px, the map's camera "
                f"{camera.width_px}x{camera.height_px} px"
            )
        looked += 1
        for number, corners in detect(frame.image, tags.family):
            if name in seen[number]:
                twice.add(number)
            seen[number][name] = np.roll(corners, tags.turn, axis=0)
    if not looked:
        own = map_.keyframes.names[0] if len(map_.keyframes) else "none"
        raise MapError(
            f"none of the {count} frames is an image of the map (a frame's name: '{first:.60}', "
            f"an image's: '{own:.60}')"
        )
    if not seen:
        others = ", ".join(name for name in FAMILIES if name != tags.family)
        raise MapError(
            f"no tag of the family {tags.family} is seen in {looked} images of the map "
            f"(other families: {others})"
        )
    return _observations(map_, tags, seen, twice, looked)


def _observations(
    map_: Map, tags: Tags, seen: dict[int, dict[str, F64]], twice: set[int], looked: int
) -> Found:
    camera, kf = map_.info.camera, map_.keyframes
    notes: list[str] = []
    kept: dict[int, dict[str, F64]] = {}
    for number in sorted(tags.places):
        mine = seen.get(number, {})
        if number in twice:
            notes.append(f"tag {number} left out: two of it are seen in one image")
        elif not mine:
            notes.append(f"tag {number} left out: it is not seen in {looked} images")
        elif len(mine) < 2:
            notes.append(f"tag {number} left out: it is seen in one image; two are needed")
        else:
            kept[number] = mine
    more = sorted(set(seen) - set(tags.places))
    if more:
        notes.append(f"tags that nobody listed are seen: {', '.join(map(str, more[:20]))}")
    good: list[int] = []
    for number in kept:
        one = _as_observations({number: kept[number]}, tags, camera)
        found, _ = triangulate_observations(one, kf.names, kf.wTc, camera)
        worst = max((point.error_px for point in found), default=math.inf)
        if len(found) < len(one.points) or worst > _CONTRADICTION_PX:
            notes.append(
                f"tag {number} left out: its observations do not meet (RMS {worst:.0f} px): are "
                "there two of it?"
            )
        else:
            good.append(number)
    if not good:
        raise MapError(f"registration: none of the {len(tags.places)} tags can be used: {notes[0]}")
    return Found(_as_observations({number: kept[number] for number in good}, tags, camera), notes)


def _as_observations(
    seen: dict[int, dict[str, F64]], tags: Tags, camera: Camera
) -> PointObservations:
    points: list[str] = []
    thing: list[int] = []
    point: list[int] = []
    world: list[F64] = []
    image: list[str] = []
    pixels: list[F64] = []
    for number, by_image in seen.items():
        places = tags.places[number]
        start = len(points)
        whole = len(places) == 4
        points += [f"tag {number}, {c}" for c in _CORNERS] if whole else [f"tag {number}"]
        thing += [number] * len(places)
        world += list(places)
        for name, corners in by_image.items():
            shown = corners if whole else _centre(corners, camera)
            point += range(start, start + len(places))
            image += [name] * len(places)
            pixels += list(shown)
    return PointObservations(
        points=points,
        world_m=np.array(world),
        point=np.array(point, np.int64),
        image=image,
        pixel_px=np.array(pixels),
        thing=np.array(thing, np.int64),
    )


def _centre(corners: F64, camera: Camera) -> F64:
    """The image (1, 2) of a square's centre, where its diagonals meet once the lens is undone."""
    rays = np.column_stack([camera.undistort(corners), np.ones(4)])
    centre = np.cross(np.cross(rays[0], rays[2]), np.cross(rays[1], rays[3]))
    if not abs(centre[2]) >= 1e-15:  # nor where a corner is beyond what is used of a fisheye
        return np.asarray(corners.mean(axis=0)[None])
    return camera.distort(centre[None, :2] / centre[2])
