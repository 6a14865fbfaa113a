"""Reads a COLMAP model's text files, as they are described in COLMAP's "Output Format"."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ground_station.map.colmap_files import (
    NO_POINT,
    OTHERS,
    PARAMETERS,
    CameraEntry,
    Fault,
    Files,
    ImageEntry,
    Tracks,
    add,
    check_camera,
    check_pose,
)

_MOST = 2**32
"""COLMAP's numbers of cameras and images, and places of key points, are below."""


def read(folder: Path) -> tuple[dict[int, CameraEntry], dict[int, ImageEntry]]:
    """Cameras and images of any model whose lens ours can hold; raises `MapError` with one line."""
    with Files(folder) as files:
        cameras = _cameras(_lines(files.read("cameras.txt")))
        images = _images(_lines(files.read("images.txt")), cameras)
        _points(_lines(files.read("points3D.txt")), images)
    return cameras, images


def _lines(data: bytes) -> Iterator[tuple[int, str]]:
    """Lines with their numbers; a last line without an end was cut, maybe within a number."""
    try:
        text = data.decode()
    except UnicodeDecodeError:
        raise Fault("it is not UTF-8") from None
    if text and not text.endswith("\n"):
        raise Fault("it is cut: its last line has no end")
    # Nothing but its end ends a line: names may hold odd characters.
    for number, line in enumerate(text.split("\n"), start=1):
        yield number, line.removesuffix("\r")


def _filled(lines: Iterator[tuple[int, str]]) -> Iterator[tuple[int, list[str]]]:
    """The words of the lines that are neither empty nor a comment."""
    for number, line in lines:
        if line.strip() and not line.lstrip().startswith("#"):
            yield number, line.split()


def _cameras(lines: Iterator[tuple[int, str]]) -> dict[int, CameraEntry]:
    cameras: dict[int, CameraEntry] = {}
    for line, words in _filled(lines):
        if len(words) < 4:
            raise Fault(f"line {line}: it is cut")
        number = _whole(words[0], line)
        if words[1] not in PARAMETERS:
            raise Fault(f"camera {number} has the model {words[1]:.40}; {OTHERS}")
        params = _reals(words[4:], line)
        if len(params) != PARAMETERS[words[1]]:
            raise Fault(f"line {line}: {words[1]} has {PARAMETERS[words[1]]} parameters")
        camera = CameraEntry(words[1], _whole(words[2], line), _whole(words[3], line), params)
        check_camera(number, camera)
        add(cameras, number, "camera")
        cameras[number] = camera
    return cameras


def _images(
    lines: Iterator[tuple[int, str]], cameras: dict[int, CameraEntry]
) -> dict[int, ImageEntry]:
    """Two lines an image; the second may be empty."""
    images: dict[int, ImageEntry] = {}
    for line, text in lines:
        if not text.strip() or text.lstrip().startswith("#"):
            continue
        words = text.split(maxsplit=9)  # a name may hold spaces
        if len(words) < 10:
            raise Fault(f"line {line}: it is cut")
        number, camera = _whole(words[0], line), _whole(words[8], line)
        pose = _reals(words[1:8], line)
        add(images, number, "image")
        check_pose(pose)
        if camera not in cameras:
            raise Fault(f"image {number} is of a camera that is not there")
        line, text = next(lines, (line + 1, ""))
        observations = text.split()
        if len(observations) % 3:
            raise Fault(f"line {line}: it is cut")
        _reals([word for k, word in enumerate(observations) if k % 3 < 2], line)
        points = [
            NO_POINT if word == "-1" else _whole(word, line, 2**64) for word in observations[2::3]
        ]
        images[number] = ImageEntry(words[9].rstrip(), camera, pose, np.array(points, np.uint64))
    return images


def _points(lines: Iterator[tuple[int, str]], images: dict[int, ImageEntry]) -> None:
    tracks = Tracks(images)
    for line, words in _filled(lines):
        if len(words) < 8 or len(words) % 2:
            raise Fault(f"line {line}: it is cut")
        position = _reals(words[1:4], line)
        observations = [_whole(word, line) for word in words[8:]]
        tracks.add(_whole(words[0], line, 2**64), position, observations[::2], observations[1::2])
    tracks.end()


def _whole(word: str, line: int, limit: int = _MOST) -> int:
    if not (word.isascii() and word.isdigit() and len(word) <= 20 and int(word) < limit):
        raise Fault(f"line {line}: '{word:.40}' is no number that may stand there")
    return int(word)


def _reals(words: list[str], line: int) -> tuple[float, ...]:
    try:
        values = tuple(float(word) for word in words)
    except ValueError:
        values = (float("nan"),)
    if not np.isfinite(values).all():
        raise Fault(f"line {line}: a number in it is none")
    return values
