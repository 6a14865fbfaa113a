"""The lens a build starts with: a camera file, an input's own camera, its metadata, or a guess."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from ground_station.errors import CameraError
from ground_station.geometry.camera import Camera, load_camera
from ground_station.geometry.resizing import for_pictures
from ground_station.recording.frames import FrameSource
from ground_station.recording.look import Look, check_one_lens, look

KNOWN = {
    # Focal length over the picture's longer side. Angles of view are the makers', turned into it
    # by 1 / (2 tan(angle / 2)), of diagonals after 4:3 or 16:9 was taken out of them.
    "Raspberry Pi camera 1, 53.5° wide": 0.992,
    "Raspberry Pi camera 2, 62.2° wide": 0.829,
    "Raspberry Pi camera 2 as the thesis calibrated it, 640x480": 0.784,
    "Raspberry Pi camera 3, 66° wide": 0.770,
    "Raspberry Pi camera 3 wide, 102° wide": 0.405,
    "phone, main camera, 24 mm equivalent, 4:3": 0.693,
    "phone, main camera, 26 mm equivalent, 4:3": 0.751,
    "phone, main camera, 28 mm equivalent, 4:3": 0.809,
    "phone, ultra-wide camera, 13 mm equivalent, 4:3": 0.376,
    "action camera, 16 mm equivalent, 16:9": 0.424,
    "FPV camera, 2.1 mm before 1/3 inch (4.8 mm wide)": 0.438,
    "ESP32-CAM, OV2640, 66° diagonal, 4:3": 0.962,
    "Tello, 82.6° diagonal, 4:3": 0.711,
    "webcam, 78° diagonal, 16:9": 0.708,
    "RealSense D435, colour, 69° wide": 0.728,
    "Kinect, colour, 525 px of 640": 0.820,
    "TUM RGB-D, freiburg1, 517.3 px of 640": 0.808,
    "EuRoC's drone, 458.7 px of 752": 0.610,
}
"""Cameras that phones, toys and small aircraft have."""

GUESS = statistics.median(KNOWN.values())
"""For a lens of which nothing is known; 1.2, COLMAP's, is longer than any of theirs."""
SIGMA_GUESS = math.sqrt(statistics.fmean(math.log(value / GUESS) ** 2 for value in KNOWN.values()))
"""How far they lie off it: the ordinary ones a tenth, the wide ones up to a half."""

SIGMA_FILE = 0.02
"""Of a camera that somebody measured, as a share. A calibration itself is ten times better, but the
file may be of another camera of the same make, of another focus, or roughly right: two and a half
deviations are the 5 % that an adjustment is to find back from."""


@dataclass(frozen=True)
class LensPrior:
    """A nominal camera and how far it may be off.

    `source` says where the camera came from. `sigma_focal` is the standard deviation of the focal
    length as a share of it. Where the camera is not `calibrated`, its distortion is unknown, too.
    """

    camera: Camera
    source: Literal["file", "recording", "metadata", "guess"]
    sigma_focal: float

    @property
    def calibrated(self) -> bool:
        """Whether somebody measured this lens; its file may still be another camera's."""
        return self.source in ("file", "recording")


@dataclass(frozen=True)
class FirstLens:
    """What is known of the lens that took all inputs, and lines to say of it.

    Displays turn the pictures clockwise by `display_deg`; 0 where inputs differ in that.
    """

    prior: LensPrior
    said: list[str] = field(default_factory=list)
    display_deg: int = 0


def known_lens(
    camera: str | None, paths: Sequence[str], sources: Sequence[FrameSource]
) -> FirstLens:
    """What is known of the lens that took all inputs.

    `camera` is a camera file, fitted to the pictures' size where they show the same; without one
    the inputs' own camera counts, and where none has one, their metadata or a guess. Raises
    `CameraError` where that contradicts itself, and what reading the first pictures raises.
    """
    if camera is not None:
        return _by_file(camera, paths, sources)
    carried = [source.camera for source in sources]
    first = carried[0]
    if first is None and not any(carried):
        return _by_looks(paths, sources)
    for path, own in zip(paths, carried, strict=True):
        if own is None or first is None:
            without = paths[carried.index(None)]
            raise CameraError(
                f"{without}: does not carry a camera, other inputs do; give one with --camera"
            )
        if own != first:
            raise CameraError(f"{path}: was taken by another camera than {paths[0]}")
    assert first is not None  # the loop has seen it
    return FirstLens(LensPrior(first, "recording", SIGMA_FILE))


def _by_file(camera: str, paths: Sequence[str], sources: Sequence[FrameSource]) -> FirstLens:
    measured = load_camera(camera)
    looks = [look(source) for source in sources]
    fitted: list[Camera] = []
    lines: list[str] = []
    for path, seen in zip(paths, looks, strict=True):
        one, line = for_pictures(measured, seen.size_px, seen.display_deg, path)
        fitted.append(one)
        lines += [line] if line else []
        if one != fitted[0]:
            raise CameraError(
                f"{path}: its pictures are {_size(seen)} px, turned by {seen.display_deg}°, those "
                f"of {paths[0]} otherwise: a map has one camera; build it from one of them"
            )
    return FirstLens(LensPrior(fitted[0], "file", SIGMA_FILE), lines, _turn(looks))


def _by_looks(paths: Sequence[str], sources: Sequence[FrameSource]) -> FirstLens:
    looks = [look(source) for source in sources]
    for path, seen in zip(paths, looks, strict=True):
        if seen.size_px != looks[0].size_px:
            raise CameraError(
                f"{path}: its pictures are {_size(seen)} px, those of {paths[0]} "
                f"{_size(looks[0])}: a map has one camera; build it from one of them"
            )
    for source in sources:
        check_one_lens(source)
    told = [(path, seen.focal) for path, seen in zip(paths, looks, strict=True) if seen.focal]
    width, height = looks[0].size_px
    remedy = "the build refines it; `blimp calibrate` measures it"
    if not told:
        focal_px = GUESS * max(width, height)
        line = (
            f"no input tells of its lens: a focal length of {focal_px:.0f} px is guessed "
            f"({GUESS:.2f} of the longer side; {_about(SIGMA_GUESS)}): {remedy}"
        )
        guessed = LensPrior(_nominal(width, height, focal_px), "guess", SIGMA_GUESS)
        return FirstLens(guessed, [line], _turn(looks))
    path, focal = told[0]
    for other, theirs in told:
        if abs(theirs.px / focal.px - 1) > max(theirs.sigma, focal.sigma):
            raise CameraError(
                f"{other}: was taken with another lens ({theirs.tag}) than {path} ({focal.tag}): "
                "a map has one camera; build it from one of them"
            )
    line = (
        f"focal length {focal.px:.0f} px by {focal.tag} ({_about(focal.sigma)}), distortion "
        f"unknown: {remedy}"
    )
    told_of = LensPrior(_nominal(width, height, focal.px), "metadata", focal.sigma)
    return FirstLens(told_of, [line], _turn(looks))


def _turn(looks: Sequence[Look]) -> int:
    turns = {seen.display_deg for seen in looks}
    return turns.pop() if len(turns) == 1 else 0


def _nominal(width: int, height: int, focal_px: float) -> Camera:
    """A pinhole with square pixels and its axis in the middle of the picture."""
    return Camera(
        width_px=width,
        height_px=height,
        fx_px=focal_px,
        fy_px=focal_px,
        cx_px=(width - 1) / 2,
        cy_px=(height - 1) / 2,
    )


def _about(sigma: float) -> str:
    return f"standard deviation {100 * sigma:.0f} %"


def _size(seen: Look) -> str:
    return f"{seen.size_px[0]}x{seen.size_px[1]}"
