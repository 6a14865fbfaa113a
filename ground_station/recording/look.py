"""What an input's pictures are before any is used: their size, how they stand, and their lens.

Pictures are given as they are stored, as the sensor took them: a rotation flag is only told here.
So a camera that was calibrated with the same camera held another way fits, and video and stills of
a phone that is turned keep one size.
"""

from __future__ import annotations

import math
import struct
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from PIL import ExifTags, Image

from ground_station.errors import CameraError
from ground_station.recording.folder import ImageFolder, read_grey
from ground_station.recording.frames import FrameSource
from ground_station.recording.video import VideoFile

# FFmpeg, and PyAV with it, gives the keys of the movie only; phones write those of the lens into
# the track. Layout: Apple, QuickTime File Format, "Metadata" (atoms `meta`, `keys`, `ilst`,
# `data`).

_MOST_BYTES = 64 << 20
"""Of the atom `moov`: an hour of video has a few megabytes."""
_DEPTH = {b"trak", b"udta"}
_UTF8 = 1
_SIGNED = {21, 65, 66, 67, 74}
_UNSIGNED = {22, 75, 76, 77, 78}
_FLOATS = {(23, 4): ">f", (24, 8): ">d"}


def metadata(path: Path) -> dict[str, str | int | float]:
    """The keys of movie and tracks with their values; empty for any other file."""
    try:
        with path.open("rb") as file:
            return dict(_keyed(_moov(file)))
    except (OSError, struct.error, ValueError):
        return {}


def _moov(file: BinaryIO) -> bytes:
    """What the atom `moov` holds; empty where there is none."""
    end = file.seek(0, 2)
    at = 0
    while at + 8 <= end:
        file.seek(at)
        size, kind = struct.unpack(">I4s", file.read(8))
        head = 8
        if size == 1:
            (size,), head = struct.unpack(">Q", file.read(8)), 16
        size = size or end - at
        if size < head:
            break
        if kind == b"moov":
            return file.read(min(size - head, _MOST_BYTES))
        at += size
    return b""


def _atoms(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Kind and content of the atoms that lie behind each other; ends where they are broken."""
    at = 0
    while at + 8 <= len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        if size < 8 or at + size > len(data):
            return
        yield kind, data[at + 8 : at + size]
        at += size


def _keyed(data: bytes) -> Iterator[tuple[str, str | int | float]]:
    for kind, content in _atoms(data):
        if kind in _DEPTH:
            yield from _keyed(content)
        elif kind == b"meta":
            # Of ISO's form four bytes of version and flags come first, of Apple's none.
            inner = dict(_atoms(content)) or dict(_atoms(content[4:]))
            if b"keys" not in inner:
                inner = dict(_atoms(content[4:]))
            names = [name for _, name in _atoms(inner.get(b"keys", b"")[8:])]
            for number, item in _atoms(inner.get(b"ilst", b"")):
                k = int.from_bytes(number, "big") - 1
                value = _value(dict(_atoms(item)).get(b"data", b""))
                if 0 <= k < len(names) and value is not None:
                    yield names[k].decode("utf-8", "replace"), value


def _value(data: bytes) -> str | int | float | None:
    if len(data) < 8:
        return None
    form, raw = int.from_bytes(data[:4], "big"), data[8:]
    if form == _UTF8:
        return raw.decode("utf-8", "replace")
    if form in _SIGNED | _UNSIGNED:
        return int.from_bytes(raw, "big", signed=form in _SIGNED)
    if (form, len(raw)) in _FLOATS:
        return float(struct.unpack(_FLOATS[form, len(raw)], raw)[0])
    return None


_FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)
"""The equivalent focal length is that of the same diagonal angle of view (CIPA DCG-001, 3.5)."""
_FILM_MM = 8.0, 800.0
"""Equivalent focal lengths of lenses that have one; a 0 means unknown (Exif 2.32, 0xA405)."""
_SIGMA_PICTURE = 0.05
"""The tag is in whole millimetres (2 % at 24), and who takes the width of 36 mm for the diagonal of
43.3 is 4 % off with pictures of 4:3."""
_SIGMA_VIDEO = 0.15
"""Tags are of the whole sensor; a video's mode and its stabilizer cut up to a quarter away."""
_TURNS_DEG = {3: 180, 6: 90, 8: 270}
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_VIDEO_KEY = "com.apple.quicktime.camera.focal_length.35mm_equivalent"
"""Apple's; MP4 has none of its own, and other makers' videos say nothing of the lens here."""


@dataclass(frozen=True)
class NominalFocal:
    """A focal length by metadata: pixels, its deviation as a share, and which tag says so."""

    px: float
    sigma: float
    tag: str


@dataclass(frozen=True)
class Look:
    """Width and height of the stored pictures; displays turn them clockwise by `display_deg`."""

    size_px: tuple[int, int]
    display_deg: int = 0
    focal: NominalFocal | None = None


def look(source: FrameSource) -> Look:
    """Looks at the first picture of an input; raises what reading it raises.

    The focal length is a folder's or a video's, where its metadata have one.
    """
    if isinstance(source, ImageFolder):
        return _at_picture(source.paths[0])
    if isinstance(source, VideoFile):
        width, height, display_deg = source.first_picture()
        return Look((width, height), display_deg, _of_video(source.path, width, height))
    height, width = next(iter(source)).image.shape
    return Look((width, height))


def check_one_lens(source: FrameSource) -> None:
    """Raises `CameraError` where two pictures of a folder tell of different lenses or zooms."""
    if not isinstance(source, ImageFolder):
        return
    first: NominalFocal | None = None
    for path in source.paths:
        here = _at_picture(path).focal
        first = first or here
        if here and first and abs(here.px / first.px - 1) > _SIGMA_PICTURE:
            raise CameraError(
                f"{path}: was taken with another lens or zoom ({here.tag}) than those before it "
                f"({first.tag}): a map has one camera; keep the pictures of one lens"
            )


def _at_picture(path: Path) -> Look:
    """By the picture's header alone; what Pillow cannot read is left to who decodes it."""
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path) as picture:
            size, exif = picture.size, picture.getexif()
            tags = dict(exif.get_ifd(ExifTags.IFD.Exif))
            turn = exif.get(ExifTags.Base.Orientation)
    except Exception:  # of a damaged header Pillow raises errors of many kinds
        height, width = read_grey(path).shape
        return Look((width, height))
    return Look(size, _TURNS_DEG.get(_whole(turn), 0), _of_picture(tags, *size))


def _of_picture(tags: Mapping[int, Any], width: int, height: int) -> NominalFocal | None:
    """By the equivalent focal length, or the true one and the pixels to a millimetre."""
    film_mm = _number(tags.get(ExifTags.Base.FocalLengthIn35mmFilm))
    if _FILM_MM[0] <= film_mm <= _FILM_MM[1]:
        return _equivalent(film_mm, width, height, _SIGMA_PICTURE, "EXIF FocalLengthIn35mmFilm")
    focal_mm = _number(tags.get(ExifTags.Base.FocalLength))
    per_unit = _number(tags.get(ExifTags.Base.FocalPlaneXResolution))
    unit_mm = _MM_PER_UNIT.get(_whole(tags.get(ExifTags.Base.FocalPlaneResolutionUnit, 2)))
    taken_px = _number(tags.get(ExifTags.Base.ExifImageWidth)) or width
    if not (focal_mm > 0 and per_unit > 0 and unit_mm):
        return None
    px = focal_mm * per_unit / unit_mm * width / taken_px
    film_mm = px * _FILM_DIAGONAL_MM / math.hypot(width, height)
    if not _FILM_MM[0] <= film_mm <= _FILM_MM[1]:
        return None
    said = f"EXIF FocalLength {focal_mm:g} mm, with FocalPlaneXResolution"
    return NominalFocal(px, _SIGMA_PICTURE, said)


def _of_video(path: Path, width: int, height: int) -> NominalFocal | None:
    film_mm = _number(metadata(path).get(_VIDEO_KEY))
    if not _FILM_MM[0] <= film_mm <= _FILM_MM[1]:
        return None
    return _equivalent(film_mm, width, height, _SIGMA_VIDEO, _VIDEO_KEY)


def _equivalent(mm: float, width: int, height: int, sigma: float, tag: str) -> NominalFocal:
    px = mm / _FILM_DIAGONAL_MM * math.hypot(width, height)
    return NominalFocal(px, sigma, f"{tag} {mm:g} mm")


def _number(value: Any) -> float:
    """A tag's value, 0 unless it is a finite number."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0
    return number if math.isfinite(number) else 0.0


def _whole(value: Any) -> int:
    return int(_number(value))
