"""A map on disk: `maps/NAME/`, and in memory: `Map`. Nothing here executes what it loads."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import tomli_w
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from ground_station.arrays import F32, F64, I32, I64
from ground_station.errors import MapError
from ground_station.geometry.camera import Camera
from ground_station.map.descriptors import Descriptors, open_descriptors, quantised
from ground_station.map.folder import check_is_map, content_id
from ground_station.map.modes import MOST, Modes
from pi_firmware.wire import config, files
from pi_firmware.wire.errors import ConfigError

FORMAT = 1
"""Raised when a reader of the older layout would misread a newer map."""

_COMPRESSED = 2
"""The format of maps that earlier versions compressed; it is not read any more."""


@dataclass
class Landmarks:
    """M points of the building, in world coordinates and metres once registered.

    `id` (M,) is the COLMAP model's point3D id; `position_m` (M, 3); `covariance_m2` (M, 3, 3) of
    the position; `descriptor` (M, D), the renormalised mean of its observations' descriptors: an
    array or, from a file, `Descriptors` that are read when they are asked for; `spread` (M,), their
    RMS distance from that mean; `view_direction` (M, 3), the unit mean direction from the point to
    the cameras that saw it; `view_cos` (M,), the cosine of the angle that holds them all;
    `distance_m` (M, 2), the nearest and farthest of them; `observations` (M,). `by_focal_m` (M, 3)
    is how the position follows the share by which the map's focal length is longer, the map as a
    whole staying where it is: a wrong lens bends it. Zero where the map does not say.
    """

    id: I64
    position_m: F64
    covariance_m2: F32
    descriptor: F32 | Descriptors
    spread: F32
    view_direction: F32
    view_cos: F32
    distance_m: F32
    observations: I32
    by_focal_m: F32 = field(default_factory=lambda: np.empty((0, 3), np.float32))

    def __post_init__(self) -> None:
        if len(self.by_focal_m) == 0:
            self.by_focal_m = np.zeros((len(self.id), 3), np.float32)

    def __len__(self) -> int:
        return len(self.id)


@dataclass
class Keyframes:
    """K frames of the map: poses and which landmark each of their features observed.

    `names`, K strings; `time_ns` (K,), capture times; `wTc` (K, 4, 4); `offset` (K + 1,): the
    observations of keyframe k are rows offset[k]:offset[k + 1] of `landmark` (O,), an index into
    the landmarks, and `pixel_px` (O, 2), distorted pixels.
    """

    names: list[str]
    time_ns: I64
    wTc: F64
    offset: I64
    landmark: I32
    pixel_px: F32

    def __len__(self) -> int:
        return len(self.names)


@dataclass
class MapInfo:
    """What `map.toml` says. The tables at the end are of plain values."""

    features: str
    features_sha256: str
    dimension: int
    camera: Camera
    name: str = "map"
    frame: str = "sfm"
    """`sfm` (arbitrary scale and origin) until registered, then `world`."""
    units: str = "arbitrary"
    """`arbitrary` until registered, then `m`; with the frame `sfm` where only lengths are known."""
    format: int = FORMAT
    built: dict[str, Any] = field(default_factory=dict)
    registration: dict[str, Any] = field(default_factory=dict)
    refined: dict[str, Any] = field(default_factory=dict)
    extended: dict[str, Any] = field(default_factory=dict)
    """What `blimp map extend` added; empty for a map that never was."""

    @property
    def registered(self) -> bool:
        """Whether positions are metres in the world frame."""
        return self.frame == "world"

    @property
    def extensions(self) -> list[dict[str, Any]]:
        """The runs of `blimp map extend` on it, the last one last."""
        runs = self.extended.get("runs")
        return [run for run in runs if isinstance(run, dict)] if isinstance(runs, list) else []

    @property
    def noise_px(self) -> float | None:
        """A key point's noise as its build measured it; None where that is no length."""
        found = self.built.get("noise_px")
        return found if isinstance(found, float) and 0 < found < math.inf else None


@dataclass
class Map:
    """A map in memory; `folder` is where it was read from or goes to.

    `modes` are further descriptors of its landmarks, where it has any.
    """

    info: MapInfo
    landmarks: Landmarks
    keyframes: Keyframes
    folder: Path | None = None
    modes: Modes | None = None

    @cached_property
    def depth_m(self) -> float:
        """How far off its landmarks were seen, the median: by it a map has a scale. NaN without."""
        seen_m = self.landmarks.distance_m.mean(axis=1)
        return float(np.median(seen_m)) if len(seen_m) else float("nan")


_Arrays = dict[str, npt.NDArray[Any]]
Layout = dict[str, tuple[str, tuple[int, ...]]]
"""Of each array its type, and its shape after the first axis."""
_LANDMARKS: Layout = {
    "id": ("int64", ()),
    "position_m": ("float64", (3,)),
    "covariance_m2": ("float32", (3, 3)),
    "spread": ("float32", ()),
    "view_direction": ("float32", (3,)),
    "view_cos": ("float32", ()),
    "distance_m": ("float32", (2,)),
    "observations": ("int32", ()),
}
_BENDING: Layout = {"by_focal_m": ("float32", (3,))}
"""Maps of before have none."""
_MODES: Layout = {"mode_landmark": ("int32", ())}
_OF_MODES = "mode_"
"""Stands before the names of the modes' descriptors, which are called as the landmarks' own."""
_KEYFRAMES: Layout = {
    "time_ns": ("int64", ()),
    "wTc": ("float64", (4, 4)),
    "offset": ("int64", ()),
    "landmark": ("int32", ()),
    "pixel_px": ("float32", (2,)),
}


def save_tables(folder: Path, map_: Map) -> None:
    """Writes `map.toml`, `landmarks.safetensors` and `keyframes.safetensors` into a folder.

    Each is written beside and renamed; `map.toml` comes last, so a folder without it is no map.
    Descriptors are quantised unless the settings that the map was built with say otherwise.
    """
    quantise = bool(map_.info.built.get("settings", {}).get("quantise", True))
    lm, kf, info = map_.landmarks, map_.keyframes, map_.info
    arrays: dict[str, npt.NDArray[Any]] = {name: getattr(lm, name) for name in _LANDMARKS}
    observations: dict[str, npt.NDArray[Any]] = {name: getattr(kf, name) for name in _KEYFRAMES}
    if lm.by_focal_m.any():
        arrays["by_focal_m"] = lm.by_focal_m
    if quantise:
        arrays |= quantised(lm.descriptor)
    else:
        arrays["descriptor"] = np.asarray(lm.descriptor, np.float32)
    if map_.modes is not None and len(map_.modes):
        rows = {"descriptor": np.asarray(map_.modes.descriptor, np.float32)}
        if quantise:
            rows = quantised(map_.modes.descriptor)
        arrays["mode_landmark"] = map_.modes.landmark
        arrays |= {_OF_MODES + name: array for name, array in rows.items()}
    form = str(info.format)
    _save(folder / "landmarks.safetensors", arrays, {"format": form})
    names = "\n".join(kf.names)
    _save(folder / "keyframes.safetensors", observations, {"format": form, "names": names})
    save_info(folder, info)


def save_info(folder: Path, info: MapInfo) -> None:
    """Writes `map.toml` alone, beside and renamed."""
    document = {
        "format": info.format,
        "name": info.name,
        "frame": info.frame,
        "units": info.units,
        "features": {
            "name": info.features,
            "sha256": info.features_sha256,
            "dimension": info.dimension,
        },
        "camera": info.camera.as_dict(),
        "built": info.built,
        "registration": info.registration,
        "refined": info.refined,
    }
    if info.extended:
        document["extended"] = info.extended
    files.write(folder / "map.toml", tomli_w.dumps(document).encode())


def _save(path: Path, arrays: dict[str, npt.NDArray[Any]], metadata: dict[str, str]) -> None:
    files.write(path, save({k: np.ascontiguousarray(v) for k, v in arrays.items()}, metadata))


def coordinates_id(folder: Path, info: MapInfo) -> str:
    """Tells coordinates from others: a map has those of the map that it was extended from first."""
    first = next((str(run["of"]) for run in info.extensions if "of" in run), None)
    of = repr((first or content_id(folder), info.registration))
    return hashlib.sha256(of.encode()).hexdigest()[:16]


def load_info(folder: str | Path) -> MapInfo:
    """Reads `map.toml`; raises `MapError` with one line."""
    folder = Path(folder)
    path = folder / "map.toml"
    check_is_map(folder)
    try:
        document = config.read(path)
        features, camera = document.get("features"), document.get("camera")
        if not isinstance(features, dict) or not isinstance(camera, dict):
            raise MapError(f"{path}: the tables 'features' and 'camera' are needed")
        if document.get("format") == _COMPRESSED:
            raise MapError(
                f"{path}: a compressed map, as earlier versions made them; "
                "take the map that it was made of, or build it again"
            )
        if document.get("format") != FORMAT:
            raise MapError(f"{path}: format {document.get('format')}; this program reads {FORMAT}")
        return MapInfo(
            features=str(features.get("name")),
            features_sha256=str(features.get("sha256")),
            dimension=int(features.get("dimension", 0)),
            camera=config.from_mapping(camera, Camera, where=f"{path}, camera"),
            name=str(document.get("name", folder.name)),
            frame=str(document.get("frame", "sfm")),
            units=str(document.get("units", "arbitrary")),
            built=dict(document.get("built", {})),
            registration=dict(document.get("registration", {})),
            refined=dict(document.get("refined", {})),
            extended=dict(document.get("extended", {})),
            format=int(document["format"]),
        )
    except ConfigError as error:
        raise MapError(str(error)) from None
    except (ValueError, TypeError, OverflowError):
        raise MapError(f"{path}: a key is not of its kind") from None


def load(folder: str | Path) -> Map:
    """Reads a whole map; raises `MapError` naming the file and what is wrong with it."""
    folder = Path(folder)
    info = load_info(folder)
    path = folder / "landmarks.safetensors"
    arrays = _landmarks(path)
    m = len(arrays["id"])
    descriptor = open_descriptors(path, m, info.dimension)
    modes = _modes(path, m, info.dimension)
    landmarks = Landmarks(descriptor=descriptor, **arrays)
    path = folder / "keyframes.safetensors"
    arrays, metadata = _read(path, _KEYFRAMES)
    names = metadata.get("names", "").split("\n") if metadata.get("names") else []
    keyframes = Keyframes(names=names, **{name: arrays[name] for name in _KEYFRAMES})
    k, o = len(names), len(keyframes.landmark)
    offset = keyframes.offset
    if (
        len(keyframes.wTc) != k
        or len(keyframes.time_ns) != k
        or len(offset) != k + 1
        or len(keyframes.pixel_px) != o
        or (np.diff(offset) < 0).any()
        or offset[0] != 0
        or offset[-1] != o
        or (o and (keyframes.landmark.min() < 0 or keyframes.landmark.max() >= m))
    ):
        raise MapError(f"{path}: its arrays do not fit each other")
    return Map(info, landmarks, keyframes, folder, modes)


def _modes(path: Path, count: int, dimension: int) -> Modes | None:
    """The modes of a file of `count` landmarks, where it has any."""
    arrays, _ = _read(path, {}, _MODES)
    landmark = arrays.get("mode_landmark")
    if landmark is None:
        return None
    if (landmark < 0).any() or (landmark >= count).any() or (np.diff(landmark) < 0).any():
        raise MapError(f"{path}: 'mode_landmark' does not name its landmarks in order")
    if len(landmark) and np.bincount(landmark).max() > MOST:
        raise MapError(f"{path}: a landmark has more than {MOST} modes")
    descriptor = open_descriptors(path, len(landmark), dimension, _OF_MODES)
    return Modes(landmark, descriptor) if len(landmark) else None


def load_positions(folder: str | Path) -> F64:
    """The landmarks' positions (M, 3) and nothing else of a map; raises as `load`."""
    path, name = Path(folder) / "landmarks.safetensors", "position_m"
    load_info(folder)
    return _read(path, {name: _LANDMARKS[name]})[0][name]


def _landmarks(path: Path) -> _Arrays:
    """The arrays of `_LANDMARKS` and `_BENDING`, of as many rows each."""
    arrays, _ = _read(path, _LANDMARKS, _BENDING)
    if len({len(array) for array in arrays.values()}) > 1:
        raise MapError(f"{path}: its arrays differ in length")
    return arrays


def _read(
    path: Path, wanted: Layout, optional: Layout | None = None
) -> tuple[_Arrays, dict[str, str]]:
    every = wanted | (optional or {})
    try:
        with safe_open(path, framework="numpy") as file:
            names = [name for name in file.keys() if name in every]  # noqa: SIM118
            arrays = {name: file.get_tensor(name) for name in names}
            metadata = file.metadata() or {}
    except (SafetensorError, OSError, ValueError, TypeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise MapError(f"{path}: {reason}; copy the map again, or build it again") from None
    check_arrays(path, arrays, wanted, optional)
    return arrays, metadata


def check_arrays(
    path: Path, arrays: _Arrays, wanted: Layout, optional: Layout | None = None
) -> None:
    """Raises `MapError` unless a file's arrays are there, of their types, and of finite numbers."""
    for name, (dtype, shape) in (wanted | (optional or {})).items():
        if name not in arrays:
            if name not in wanted:
                continue
            raise MapError(f"{path}: the array '{name}' is missing")
        array = arrays[name]
        if array.dtype != dtype or array.ndim == 0 or array.shape[1:] != shape:
            rows = ", ".join(["N", *map(str, shape)])
            raise MapError(
                f"{path}: '{name}' must be {dtype} ({rows}), not {array.dtype} {array.shape}"
            )
        if not np.isfinite(array).all():
            raise MapError(f"{path}: '{name}' holds a value that is not finite")


def check_features(info: MapInfo, name: str, sha256: str) -> None:
    """Raises `MapError` naming both when a map was built with other features."""
    if (info.features, info.features_sha256) != (name, sha256):
        raise MapError(
            f"the map '{info.name}' was built with '{info.features}' "
            f"({info.features_sha256[:12]}), the localizer uses '{name}' ({sha256[:12]})"
        )
