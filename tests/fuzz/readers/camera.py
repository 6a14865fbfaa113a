"""`ground_station.geometry.camera`: camera files."""

from __future__ import annotations

import numpy as np
import tomli_w
from pieces import Picker, refusing, scratch, stretch, with_a_line

from ground_station.errors import CameraError
from ground_station.geometry.camera import Camera, load_camera

_FILE = scratch("camera") / "camera.toml"
_WHOLE = tomli_w.dumps(Camera().as_dict()).encode()


def fuzz(data: bytes) -> None:
    """One line of a camera's, or all of the file, is the input's."""
    _FILE.write_bytes(with_a_line(Picker(data), _WHOLE))
    with refusing(CameraError):
        camera = load_camera(_FILE)
        assert np.isfinite(camera.matrix).all() and np.isfinite(camera.distortion).all()


def seeds() -> list[bytes]:
    """A whole one; numbers that are none; keys that nest."""
    return [
        b"\xff" + _WHOLE,
        b"\2fx_px = nan",
        b"\2fx_px = 0x" + b"f" * 400,
        b"\2fx_px = [1]",
        b"\x0cmodel = [0x" + b"f" * 3800 + b"]",
        stretch((1, b"\x0cmodel = [0x"), (6000, b"f"), (1, b"]")),
        stretch((1, b"\x0cmodel."), (5000, b"a."), (1, b"b = 1")),
        stretch((1, b"\xff"), (5000, b"a."), (1, b"b = 1")),
        stretch((1, b"\xff"), (200_000, b"a."), (1, b"b = 1")),
        stretch((1, b"\xffa = "), (5000, b"[")),
        stretch((1, b"\xffa = "), (5000, b"{a=")),
        stretch((1, b"\xff"), (100_000, b"[[a]]\n")),
    ]
