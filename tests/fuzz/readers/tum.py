"""`ground_station.geometry.trajectory`: TUM text."""

from __future__ import annotations

import numpy as np
from pieces import refusing, scratch, stretch

from ground_station.errors import GeometryError
from ground_station.geometry.trajectory import read_tum

_FILE = scratch("tum") / "trajectory.txt"


def fuzz(data: bytes) -> None:
    """Poses that are taken are in order, finite, and rotations."""
    _FILE.write_bytes(data)
    with refusing(GeometryError):
        found = read_tum(_FILE)
        assert (np.diff(found.time_ns) >= 0).all() and np.isfinite(found.position_m).all()
        assert np.allclose(np.linalg.norm(found.quaternion_xyzw, axis=1), 1)
        assert np.isfinite(found.wTc).all()


def seeds() -> list[bytes]:
    """Plain, with commas and comments, and numbers at their limits."""
    return [
        b"# timestamp tx ty tz qx qy qz qw\n1.5 1 2 3 0 0 0 1\n0.5,1,2,3,0,0,0.7,0.7\n",
        b"1e3 1 2 3 0 0 0 1\n",
        b"1 1 2 3 1e200 0 0 1e200\n",
        b"1 1e308 2 3 0 0 0 1e-5\n",
        b"-9223372036.8 1 2 3 0 0 0 1\n",
        "²3 1 2 3 0 0 0 1\n١ 1 2 3 0 0 0 1\n".encode(),
        b"1" * 4000 + b" 1 2 3 0 0 0 1\n",
        stretch((1, b""), (100_000, b"1"), (1, b" 1 2 3 0 0 0 1")),
        stretch((30_000, b"1 1 2 3 0 0 0 1\n")),
    ]
