"""What every input gives: frames in order of time, and the camera when the input knows it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from ground_station.geometry.camera import Camera


@dataclass(frozen=True)
class Frame:
    """One picture. `index` counts in the input from 0; `image` is (H, W) uint8, grey."""

    index: int
    name: str
    time_ns: int
    image: npt.NDArray[np.uint8]


class FrameSource(Protocol):
    """A folder of images, a video file or a recording. Iterating opens it anew from its start.

    `camera` is None unless the input carries one; `notes` holds lines a person should see, such as
    where a cut recording ends (complete only after the iteration).
    """

    camera: Camera | None
    notes: list[str]

    def __iter__(self) -> Iterator[Frame]: ...

    def count(self) -> int | None:
        """The number of frames when it is known without decoding, else None."""
        ...
