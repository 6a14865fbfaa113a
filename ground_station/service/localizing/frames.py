"""The frames that come over the bus, taken only when they are what they say."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ground_station.recording.frames import plausible_exposure_s
from ground_station.service.bus_messages import FrameMessage
from ground_station.service.pictures import PictureReader

GONE = "its picture was overwritten before it was read"
_WHOLE = (
    "slot", "stamp", "sequence", "time_ns", "clock_ns", "arrival_ns", "width_px", "height_px",
    "ssrc",
)  # fmt: skip


@dataclass(frozen=True)
class Taken:
    """A frame with its picture (H, W) uint8; `exposure_s` is None where it cannot be."""

    note: FrameMessage
    image: npt.NDArray[np.uint8]
    exposure_s: float | None


def fault_of(note: FrameMessage) -> str:
    """What makes a message impossible, in words; "" when nothing does.

    A note's constructor takes any JSON value for any field.
    """
    for name in _WHOLE:
        value = getattr(note, name)
        if type(value) is not int or not 0 <= value < 1 << 63:
            return f"{name} is {value!r:.40}, not a whole number from 0"
    capture_ns = note.capture_ns
    if capture_ns is not None and (type(capture_ns) is not int or abs(capture_ns) >= 1 << 63):
        return f"capture_ns is {capture_ns!r:.40}, not a whole number"
    return ""


def take(pictures: PictureReader, note: FrameMessage) -> Taken | str:
    """The frame of a message, or why there is none, in words."""
    if fault := fault_of(note):
        return fault
    image = pictures.read(note.slot, note.stamp)
    if image is None:
        return GONE
    height, width = image.shape
    if (width, height) != (note.width_px, note.height_px):
        return f"its picture has {width}x{height} px, not {note.width_px}x{note.height_px}"
    return Taken(note, image, plausible_exposure_s(note.exposure_s))
