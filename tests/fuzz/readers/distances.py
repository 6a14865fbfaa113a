"""`ground_station.mapping.registration.distances`: DISTANCES.csv."""

from __future__ import annotations

import numpy as np
from pieces import refusing, scratch, stretch, under

from ground_station.errors import MapError
from ground_station.mapping.registration.distances import COLUMNS, read_distances

_FILE = scratch("distances") / "DISTANCES.csv"
_HEAD = ",".join((*COLUMNS, "sigma_m")).encode() + b"\n"


def fuzz(data: bytes) -> None:
    """Lengths that are taken are finite and have two ends."""
    _FILE.write_bytes(under(_HEAD, data))
    with refusing(MapError):
        distances = read_distances(_FILE)
        count = len(distances.names)
        for values in (distances.length_m, distances.sigma_m):
            assert values.shape == (count,) and np.isfinite(values).all() and (values > 0).all()
        assert np.isfinite(distances.ends.pixel_px).all()
        assert len(distances.ends.points) == 2 * count > distances.ends.point.max()


def seeds() -> list[bytes]:
    """Whole, with ends that are missing, lengths that contradict each other, no numbers."""
    return [
        b"\0wall,a,1.png,1,2,5,0.01\nwall,b,1.png,7,2,5,0.01\nwall,a,2.png,1,3,5,\n",
        b"\0wall,a,1.png,1,2,5\n",
        b"\0wall,c,1.png,1,2,5,0.01\n",
        b"\0wall,a,1.png,1,2,5,0.01\nwall,b,1.png,7,2,6,0.01\n",
        b"\0wall,a,1.png,nan,1e999,inf,-1\n",
        b"distance,end,image,u_px,v_px,length_m\nwall,a,1.png,1,2,5\n",
        stretch((1, b"\0"), (200_000, b"a")),
        stretch((1, b"\0"), (20_000, b"wall,a,b,1,2,5,0.01\n")),
    ]
