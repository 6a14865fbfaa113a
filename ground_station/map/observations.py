"""What a flight saw of a map's landmarks: the file that `blimp map refine` reads.

A safetensors file: names, types and sizes are checked before use and nothing is executed. It says
which landmarks it means by a hash of them, so that observations of another map are refused.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from ground_station.arrays import F32, F64, I64
from ground_station.errors import CameraError, MapError
from ground_station.files import write_bytes
from ground_station.geometry.camera import Camera
from ground_station.map.store import Landmarks, Layout, check_arrays
from pi_firmware.wire import config
from pi_firmware.wire.errors import ConfigError

FORMAT = 1
KIND = "blimp-observations"
"""In the file's metadata, so that another safetensors file is told apart."""

_RIGID = 1e-6
"""How far a stored rotation may be from orthonormal."""

_ROWS = 1 << 14
"""Descriptors that are hashed together: 8 MB."""

_LONGEST_NAME = 200

_LATEST_NS = 2**62
"""Times whose differences still fit 64 bits."""


@dataclass(frozen=True)
class FlightObservations:
    """F frames that were localized in a map, and the observations they were solved from.

    `time_ns` (F,), increasing; `wTc` (F, 4, 4), the localizer's poses in the map's coordinates;
    the observations of frame f are rows offset[f]:offset[f + 1] of `landmark` (O,), the landmarks'
    ids, and `pixel_px` (O, 2), distorted pixels of `camera`. `name` is the flight's, `map` the
    map's; `landmarks_sha256` is that of the map it was localized in."""

    name: str
    map: str
    landmarks_sha256: str
    camera: Camera
    time_ns: I64
    wTc: F64
    offset: I64
    landmark: I64
    pixel_px: F32

    def __len__(self) -> int:
        return len(self.time_ns)


_LAYOUT: Layout = {
    "time_ns": ("int64", ()),
    "wTc": ("float64", (4, 4)),
    "offset": ("int64", ()),
    "landmark": ("int64", ()),
    "pixel_px": ("float32", (2,)),
}


def landmarks_sha256(landmarks: Landmarks) -> str:
    """A hash of the landmarks' ids and descriptors, whatever their positions.

    Registration and refinement move landmarks, and they remain what was seen.
    """
    digest = hashlib.sha256(landmarks.id.astype("<i8").tobytes())
    for start in range(0, len(landmarks), _ROWS):
        rows = np.asarray(landmarks.descriptor[start : start + _ROWS], np.float32)
        top = np.maximum(np.abs(rows).max(axis=1, keepdims=True, initial=0), 1e-12)
        # As whole numbers: the last bit of a normalised row is another on another machine.
        digest.update(np.round(rows * (127 / top)).astype(np.int8).tobytes())
    return digest.hexdigest()


def save_observations(path: str | Path, seen: FlightObservations) -> None:
    """Writes the file, beside and renamed; raises `GroundStationError` when the disk refuses."""
    arrays: dict[str, npt.NDArray[Any]] = {
        name: np.ascontiguousarray(getattr(seen, name)) for name in _LAYOUT
    }
    metadata = {
        "kind": KIND,
        "format": str(FORMAT),
        "name": seen.name,
        "map": seen.map,
        "landmarks_sha256": seen.landmarks_sha256,
        "camera": json.dumps(seen.camera.as_dict()),
    }
    write_bytes(path, save(arrays, metadata))


def load_observations(path: str | Path) -> FlightObservations:
    """Reads the file; raises `MapError` with one line that names it and what is wrong."""
    path = Path(path)
    arrays, metadata = _read(path)
    try:
        document = json.loads(metadata["camera"])
        camera = config.from_mapping(document, Camera, where=f"{path}, camera")
        seen = FlightObservations(
            name=metadata["name"],
            map=metadata["map"],
            landmarks_sha256=metadata["landmarks_sha256"],
            camera=camera,
            **{name: arrays[name] for name in _LAYOUT},
        )
    except KeyError as error:
        raise MapError(f"{path}: its metadata lacks {error}") from None
    except (ConfigError, CameraError) as error:
        raise MapError(str(error)) from None
    except (ValueError, TypeError, AttributeError, RecursionError):
        raise MapError(f"{path}: the camera in its metadata cannot be read") from None
    if (fault := _fault(seen)) is not None:
        raise MapError(f"{path}: {fault}")
    return seen


def _read(path: Path) -> tuple[dict[str, npt.NDArray[Any]], dict[str, str]]:
    if not path.is_file():
        raise MapError(f"{path}: there is no such file")
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            if metadata.get("kind") == KIND and metadata.get("format") != str(FORMAT):
                raise MapError(
                    f"{path}: format {metadata.get('format')!r:.20}; this program reads {FORMAT}"
                )
            arrays = {
                name: file.get_tensor(name)
                for name in file.keys()  # noqa: SIM118
                if name in _LAYOUT
            }
    except (SafetensorError, OSError, ValueError, TypeError, OverflowError):
        metadata, arrays = {}, {}
    if metadata.get("kind") != KIND:
        raise MapError(
            f"{path}: is no whole file of observations (a trajectory has poses only); "
            "make one with 'blimp localize … --observations F'"
        )
    check_arrays(path, arrays, _LAYOUT)
    return arrays, metadata


def _fault(seen: FlightObservations) -> str | None:
    """What does not fit in a file whose arrays have the right types, or None."""
    frames, observations, offset = len(seen.time_ns), len(seen.landmark), seen.offset
    camera, R = seen.camera, seen.wTc[:, :3, :3]
    if not seen.name.isprintable() or not 0 < len(seen.name) <= _LONGEST_NAME:
        return f"the flight's name in it is not 1 to {_LONGEST_NAME} printable characters"
    if len(seen.wTc) != frames or len(offset) != frames + 1 or len(seen.pixel_px) != observations:
        return "its arrays do not fit each other"
    if offset[0] != 0 or offset[-1] != observations or (offset[1:] < offset[:-1]).any():
        return "its arrays do not fit each other"
    if (seen.time_ns[1:] <= seen.time_ns[:-1]).any():
        return "its frames are not in order of time"
    if ((seen.time_ns < -_LATEST_NS) | (seen.time_ns > _LATEST_NS)).any():
        return "a time in it is out of range"
    off = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(initial=0)
    if off > _RIGID or (np.linalg.det(R) < 0).any() or (seen.wTc[:, 3] != [0, 0, 0, 1]).any():
        return "a pose in it is no rigid motion"
    size = np.array([camera.width_px, camera.height_px])
    if ((seen.pixel_px < -0.5) | (seen.pixel_px > size - 0.5)).any():
        return f"a pixel in it is outside of the camera's {size[0]}x{size[1]}"
    return None
