"""From the instant that a camera's timestamp marks to the one that a frame's pose is of."""

from __future__ import annotations

import enum


class Mark(enum.Enum):
    """Which instant of a frame a camera stamps, with a rolling shutter as with a global one."""

    EXPOSURE_START = "the first row begins to be exposed"
    READOUT_START = "the first row has been exposed, and its transfer begins"
    READOUT_END = "the last row has been transferred"
    MIDDLE = "the middle of the middle row's exposure"


def to_middle_ns(mark: Mark, exposure_s: float | None, readout_s: float) -> int:
    """What to add to a timestamp to get the middle of the middle row's exposure, ns.

    `readout_s` is the time from the first row to the last, 0 for a global shutter. Where the
    exposure is unknown (None) it counts as none: the result is then wrong by half of it.
    """
    half_exposure_s = (exposure_s or 0.0) / 2
    if mark is Mark.EXPOSURE_START:
        offset_s = readout_s / 2 + half_exposure_s
    elif mark is Mark.READOUT_START:
        offset_s = readout_s / 2 - half_exposure_s
    elif mark is Mark.READOUT_END:
        offset_s = -readout_s / 2 - half_exposure_s
    else:
        offset_s = 0.0
    return round(offset_s * 1e9)
