"""`ground_station.mapping.registration.picks`: PICKS.toml."""

from __future__ import annotations

import numpy as np
from pieces import refusing, scratch, stretch, under

from ground_station.errors import MapError
from ground_station.mapping.registration.picks import read_picks

_FILE = scratch("picks") / "PICKS.toml"
_HEAD = b"""format = 1
[plan]
image = "floorplan.png"
height_px = 680
resolution_m = 0.025
[up]
direction = [0.0, 0.0, 1.0]
[[pick]]
"""


def fuzz(data: bytes) -> None:
    """Picks that are taken are finite, of landmarks, and the vertical is a unit vector."""
    _FILE.write_bytes(under(_HEAD, data))
    with refusing(MapError):
        picks = read_picks(_FILE)
        assert abs(np.linalg.norm(picks.upright.direction) - 1) < 1e-9
        for pick in picks.picks:
            assert np.isfinite(pick.place).all() and np.isfinite(pick.plan_px).all()
            assert len(pick.landmarks)


def seeds() -> list[bytes]:
    """One and two picks, without landmarks, with wrong vectors, another format, no scale."""
    pick = b'name = "1"\nlandmarks = [7, 10]\nplace = [1.0, 2.0, 3.0]\nplan_px = [10.0, 20.0]\n'
    return [
        b"\0" + pick,
        b"\0" + pick + b"[[pick]]\n" + pick,
        b"\0" + pick.replace(b"7, 10", b""),
        b"\0" + pick.replace(b"1.0", b"nan"),
        b"\0" + pick.replace(b"7", b"99999999999999999999"),
        b"\0" + pick.replace(b"20.0", b"1e308, 3"),
        _HEAD.replace(b"format = 1", b"format = 2") + pick,
        _HEAD.replace(b"0.025", b"0.0") + pick,
        _HEAD.replace(b"1.0]", b"1e308]") + pick,
        stretch((1, b"\0landmarks = ["), (100_000, b"7,")),
    ]
