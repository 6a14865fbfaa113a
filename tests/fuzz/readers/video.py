"""`ground_station.recording.video` and `.open`: raw H.264, and containers that FFmpeg reads."""

from __future__ import annotations

import io

import av
import numpy as np
from pieces import Picker, refusing, scratch

from ground_station.recording.open import open_input
from pi_firmware.wire.errors import BlimpError
from readers import h264

_FOLDER = scratch("video")
_SUFFIXES = (".h264", ".mp4", ".mkv", ".avi", "")
_MOST_FRAMES = 50


def fuzz(data: bytes) -> None:
    """At most so many frames are looked at: a container may repeat one for ever."""
    picker = Picker(data)
    path = _FOLDER / f"video{picker.of(_SUFFIXES)}"
    path.write_bytes(picker.rest())
    with refusing(BlimpError):
        source = open_input(path)
        source.count()
        for number, frame in enumerate(source):
            assert frame.image.ndim == 2 and frame.image.dtype == np.uint8
            if number >= _MOST_FRAMES:
                break


def seeds() -> list[bytes]:
    """The same two pictures in each form."""
    raw = b"".join(h264.access_units())
    found = [b"\0" + raw, b"\4" + raw[:-20]]
    for number, form in ((1, "mp4"), (2, "matroska"), (3, "avi")):
        file = io.BytesIO()
        with av.open(file, "w", form) as container:
            stream = container.add_stream("mpeg4", 25)
            stream.width, stream.height, stream.pix_fmt = 32, 32, "yuv420p"
            picture = av.VideoFrame.from_ndarray(np.zeros((32, 32, 3), np.uint8), format="rgb24")
            container.mux([*stream.encode(picture), *stream.encode(None)])
        found.append(bytes([number]) + file.getvalue())
    return [seed for seed in found if len(seed) < 8192]
