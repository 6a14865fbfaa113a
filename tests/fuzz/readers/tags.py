"""`ground_station.mapping.registration.tags`: TAGS.toml."""

from __future__ import annotations

import numpy as np
from pieces import refusing, scratch, stretch, under

from ground_station.errors import MapError
from ground_station.mapping.registration.tags import read_tags

_FILE = scratch("tags") / "TAGS.toml"
_HEAD = b'family = "36h11"\nsize_m = 0.4\n[[tag]]\n'


def fuzz(data: bytes) -> None:
    """A tag that is taken has one known point or four, finite."""
    _FILE.write_bytes(under(_HEAD, data))
    with refusing(MapError):
        tags = read_tags(_FILE)
        assert tags.places and tags.turn in range(4)
        for place in tags.places.values():
            assert place.shape in ((1, 3), (4, 3)) and np.isfinite(place).all()


def seeds() -> list[bytes]:
    """By centre, by heading, by corners, of another size, and what is no tag."""
    corners = b"[[4.4, 5, 1.2], [4.8, 5, 1.2], [4.8, 5, 0.8], [4.4, 5, 0.8]]"
    return [
        b"\0id = 3\ncentre_m = [6, 2.6, 1.7]\n",
        b"\0id = 3\ncentre_m = [6, 2.6, 1.7]\nfacing_deg = 180\n",
        b"\0id = 3\ncorners_m = " + corners + b"\n",
        b"\0id = 3\ncorners_m = " + corners.replace(b"4.8", b"4.5") + b"\n",
        b"\0id = 3\ncentre_m = [nan, inf, 1e300]\n[[tag]]\nid = 3\n",
        b"\0id = -1\ncentre_m = 5\n",
        b'family = "16h5"\nsize_m = 0.1\nturn_deg = 90\ntag = [{id = 1, centre_m = [1, 2, 3]}]\n',
        stretch((1, b"\0id = "), (100_000, b"9")),
        stretch((1, b"\0id = 1\ncentre_m = "), (50_000, b"[")),
    ]
