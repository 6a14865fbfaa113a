"""`ground_station.mapping.registration.observations`: PAIRS.csv."""

from __future__ import annotations

import numpy as np
from pieces import refusing, scratch, stretch, under

from ground_station.errors import MapError
from ground_station.mapping.registration.observations import COLUMNS, read_pairs

_FILE = scratch("pairs") / "PAIRS.csv"
_HEAD = ",".join(COLUMNS).encode() + b"\n"


def fuzz(data: bytes) -> None:
    """Observations that are taken are finite and of points that are there."""
    _FILE.write_bytes(under(_HEAD, data))
    with refusing(MapError):
        observations = read_pairs(_FILE)
        assert np.isfinite(observations.world_m).all() and np.isfinite(observations.pixel_px).all()
        assert observations.point.max() < len(observations.points) and len(
            observations.image
        ) == len(observations.point)


def seeds() -> list[bytes]:
    """Plain, quoted, with columns in another order, too few and too many of them."""
    return [
        b"\0a,1.png,1,2,3,4,5\na,2.png,1,2,3,4,5\n",
        b'\0"a\nb",1.png,1,2,3,4,5\n"a\nb",2.png,1,2,3,4,6\n',
        b"\0a,1.png,1,2,3,4\n",
        b"\0a,1.png,1,2,3,4,5,6,7\n",
        b"\0a,1.png,nan,2,3,4,1e999\n",
        b"image,point,u_px,v_px,x_m,y_m,z_m\n1,a,1,2,3,4,5\n",
        b'\0"a,1.png,1,2,3,4,5\n',
        b"\0a\0b,1.png,1,2,3,4,5\n",
        stretch((1, b"\0"), (200_000, b"a")),
        stretch((1, b"\0"), (20_000, b'"a",b,1,2,3,4,5\n')),
        stretch((1, b"point"), (100_000, b",a")),
    ]
