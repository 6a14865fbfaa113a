"""What is known of a lens before a map is built: a camera file, a container's word, or a guess."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ground_station.geometry.camera import Camera

Source = Literal["file", "recording", "metadata", "guess"]


@dataclass(frozen=True)
class LensPrior:
    """A nominal camera and how far it may be off.

    `source` says where the camera came from. `sigma_focal` is the standard deviation of the focal
    length as a share of it. Where the camera is not `calibrated`, its distortion is unknown, too.
    """

    camera: Camera
    source: Source
    sigma_focal: float

    @property
    def calibrated(self) -> bool:
        """Whether somebody measured this lens; its file may still be another camera's."""
        return self.source in ("file", "recording")
