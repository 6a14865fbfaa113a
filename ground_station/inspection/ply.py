"""A map's landmarks as a PLY file, which CloudCompare and MeshLab open.

The form is Greg Turk's (Stanford, 1994), binary and little endian.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ground_station.files import write_bytes
from ground_station.map.store import Map
from ground_station.map.summary import sigma
from pi_firmware.wire.text import printable

_TYPES = {"<f4": "float", "<i4": "int"}
_PROPERTIES = (
    # name, type
    ("x", "<f4"),
    ("y", "<f4"),
    ("z", "<f4"),
    # Towards the cameras that saw it, where readers look for a surface's normal.
    ("nx", "<f4"),
    ("ny", "<f4"),
    ("nz", "<f4"),
    ("observations", "<i4"),
    ("sigma", "<f4"),
    ("descriptor_spread", "<f4"),
    ("view_angle_deg", "<f4"),
    ("nearest", "<f4"),
    ("farthest", "<f4"),
)


def ply(map_: Map) -> bytes:
    """The file's bytes, one vertex a landmark.

    `sigma` is the root of its covariance's trace, `view_angle_deg` the half angle of its viewing
    cone, `nearest` and `farthest` the distances of the keyframes that saw it; lengths are in the
    map's units.
    """
    lm, info = map_.landmarks, map_.info
    table = np.empty(len(lm), np.dtype([(name, kind) for name, kind in _PROPERTIES]))
    table["x"], table["y"], table["z"] = lm.position_m.T
    table["nx"], table["ny"], table["nz"] = lm.view_direction.T
    table["observations"] = lm.observations
    table["sigma"] = sigma(map_)
    table["descriptor_spread"] = lm.spread
    table["view_angle_deg"] = np.degrees(np.arccos(np.clip(lm.view_cos, -1, 1)))
    table["nearest"], table["farthest"] = lm.distance_m.T
    name = printable(info.name, 100).encode("ascii", "replace").decode()
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment landmarks of the map {name}, frame {info.frame!a}, units {info.units!a}",
        f"element vertex {len(lm)}",
        *(f"property {_TYPES[kind]} {name}" for name, kind in _PROPERTIES),
        "end_header",
    ]
    return ("\n".join(header) + "\n").encode("ascii") + table.tobytes()


def write_ply(path: str | Path, map_: Map) -> None:
    """Writes the file, beside and renamed; raises `GroundStationError` when the disk refuses."""
    write_bytes(path, ply(map_))
