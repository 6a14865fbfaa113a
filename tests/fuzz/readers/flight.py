"""`ground_station.recording.flight`: a recording as frames, camera and trajectories."""

from __future__ import annotations

import numpy as np
from pieces import refusing, scratch

from ground_station.recording.flight import trajectory_of
from ground_station.recording.open import open_input
from pi_firmware.wire.errors import BlimpError
from readers import mcap_file

_FILE = scratch("flight") / "flight.mcap"


def fuzz(data: bytes) -> None:
    """Frames are pictures and poses are rotations, or there are none."""
    _FILE.write_bytes(mcap_file.build(data))
    with refusing(BlimpError):
        source = open_input(_FILE)
        source.count()
        for frame in source:
            assert frame.image.ndim == 2 and frame.image.dtype == np.uint8
            assert frame.exposure_s is None or 0 < frame.exposure_s <= 1
    with refusing(BlimpError):
        found = trajectory_of(_FILE)
        assert np.allclose(np.linalg.norm(found.quaternion_xyzw, axis=1), 1)


def seeds() -> list[bytes]:
    """Small flights."""
    return mcap_file.seeds()
