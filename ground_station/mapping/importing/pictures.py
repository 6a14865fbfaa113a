"""The pictures that a model was made of, found again by their names."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ground_station.errors import InputError
from ground_station.geometry.camera import Camera
from ground_station.recording.folder import SUFFIXES, read_grey
from ground_station.recording.frames import Frame, FrameSource
from ground_station.recording.open import open_input

_DIFFER_PX = 2.0
_UNDISTORTED = "the model is of undistorted pictures; its own camera is taken"


@dataclass(frozen=True)
class Pictures:
    """Frames under the model's names, of those that are there.

    From a folder, the names are paths in it, and picture k of the sorted names is at k / rate s. Of
    a recording or video, `frame-000123`, with or without an image's suffix or the input's name
    before it, is the frame of that number.
    """

    names: Sequence[str]
    source: Path | FrameSource
    rate_hz: float
    stem: str = ""

    @property
    def camera(self) -> Camera | None:
        """The one that a recording carries."""
        return None if isinstance(self.source, Path) else self.source.camera

    @property
    def notes(self) -> list[str]:
        """What a recording or video has to say; complete after the iteration."""
        return [] if isinstance(self.source, Path) else self.source.notes

    def __iter__(self) -> Iterator[Frame]:
        if isinstance(self.source, Path):
            for k, name in enumerate(self.names):
                path = self.source / name
                if path.is_file():
                    yield Frame(k, name, round(k * 1e9 / self.rate_hz), read_grey(path))
            return
        wanted: dict[str, str] = {}
        for name in self.names:
            plain = _plain(name)
            if plain in wanted:
                raise InputError(f"'{wanted[plain]}' and '{name}' would be the same frame")
            wanted[plain] = name
        for frame in self.source:
            for name in (frame.name, f"{self.stem}/{frame.name}"):
                if name in wanted:
                    yield replace(frame, name=wanted.pop(name))
                    break


def open_pictures(where: str | Path, names: Sequence[str], rate_hz: float) -> Pictures:
    """The pictures of a folder or recording; raises `InputError` or the recording's error."""
    where = Path(where)
    if not (math.isfinite(rate_hz) and 0.001 <= rate_hz <= 10_000):
        raise InputError(f"the frame rate is {rate_hz} Hz; allowed: 0.001 to 10000 Hz")
    if where.is_dir():
        return Pictures(names, where, rate_hz)
    return Pictures(names, open_input(where, rate_hz), rate_hz, where.resolve().stem)


def taken_by(model: Camera, carried: Camera) -> tuple[Camera, str]:
    """The camera of a recording's pictures, and what is to say of it: the model's, in most cases.

    A model of undistorted pictures, as in a map's own folder `sparse`, has the recording's focal
    lengths and centre without a lens: the recording's pictures are not undistorted, so that its
    camera counts.
    """
    if model.is_pinhole and np.allclose(model.matrix, carried.matrix, atol=1e-6):
        lens = "" if carried.is_pinhole else _UNDISTORTED
        return carried, lens
    if (model.width_px, model.height_px) != (carried.width_px, carried.height_px):
        return model, ""  # said of the first picture, in one line
    v, u = np.mgrid[0 : model.height_px : 16, 0 : model.width_px : 16]
    grid = np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64)
    grid = grid[model.uses(grid)]
    off_px = float(np.linalg.norm(carried.distort(model.undistort(grid)) - grid, axis=1).max())
    if off_px <= _DIFFER_PX:
        return model, ""
    return model, f"its camera is up to {off_px:.1f} px off the model's, which is taken"


def _plain(name: str) -> str:
    """Without an image's suffix."""
    return str(Path(name).with_suffix("")) if Path(name).suffix.lower() in SUFFIXES else name
