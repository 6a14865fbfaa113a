"""The inputs of a build: recordings, videos and folders become one sequence of named frames.

Which frames: a range with a step means exactly those. Else an input set of no more frames than
`max_images` is used whole where it is short (`keyframes.choose_above`) or most of its frames are
due as keyframes: somebody has chosen already (photographs, a headset's five frames a second), and
every image more ties the map together. Of all others the keyframes are taken, for which an input is
read twice: once to choose, once for the chosen frames.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ground_station.errors import InputError
from ground_station.geometry.camera import Camera
from ground_station.mapping.construction import keyframes
from ground_station.mapping.construction.first_lens import LensPrior, known_lens
from ground_station.mapping.construction.keyframes import Choice
from ground_station.mapping.construction.motion import Figures
from ground_station.mapping.settings import MappingSettings
from ground_station.progress import Progress
from ground_station.recording.frames import Frame, FrameRange, FrameSource
from ground_station.recording.open import open_input, parse_range


@dataclass(frozen=True)
class ChosenFrames(FrameRange):
    """These frames of an input and no others."""

    indices: frozenset[int] = frozenset()

    def __contains__(self, index: int) -> bool:
        return index in self.indices

    def __str__(self) -> str:
        return f"of {len(self.indices)} chosen frames"

    def is_past(self, index: int) -> bool:
        """Whether neither this frame nor any later one is wanted."""
        return index > max(self.indices, default=-1)

    def count(self, available: int) -> int:
        """How many of `available` frames are wanted."""
        return sum(index < available for index in self.indices)


@dataclass
class Inputs:
    """The frames of all inputs in order, under names that are theirs alone; iterable again.

    `prior` is what is known of their lens; `total` is their number, where it is known; `built` is
    what map.toml shall say of them; `said` are lines about lens and choice, known at once.
    """

    prior: LensPrior
    total: int | None
    built: dict[str, Any]
    said: list[str]
    _paths: list[str]
    _sources: list[FrameSource]
    _chosen: list[int] | None = None
    _looked_at: list[FrameSource] | None = None

    @property
    def camera(self) -> Camera:
        """The camera that took the frames, as far as it is known."""
        return self.prior.camera

    def __iter__(self) -> Iterator[Frame]:
        """Raises `InputError` when a chosen frame is not there the second time."""
        several = len(self._paths) > 1
        for k, (path, source) in enumerate(zip(self._paths, self._sources, strict=True)):
            given = 0
            for frame in source:
                given += 1
                name = f"{_stem(path)}/{frame.name}" if several else frame.name
                yield dataclasses.replace(frame, name=name)
            if self._chosen is not None and given != self._chosen[k]:
                raise InputError(
                    f"{path}: gave {given} of the {self._chosen[k]} frames that were chosen from "
                    "it: it was changed while it was read"
                )

    @property
    def notes(self) -> list[str]:
        """What the inputs have to say, such as where one is cut; complete after the iteration."""
        # Who chose has read to the end, beyond the last chosen frame.
        return [note for source in self._looked_at or self._sources for note in source.notes]


def open_inputs(
    paths: Sequence[str],
    settings: MappingSettings,
    *,
    camera: str | None = None,
    rate_hz: float | None = None,
    frames: str | None = None,
) -> Inputs:
    """Opens the inputs of a map and chooses their frames.

    `camera` is a camera file instead of the inputs' own; with neither, the lens is taken from their
    metadata or guessed. `rate_hz` gives times to what has none; `frames` is a range, `A:B` or
    `A:B:S`. Raises `InputError`, `CameraError`, `MapError` or the recording's error, one line each.
    """
    paths = list(paths)
    _check_names(paths)
    for path in paths:
        _check_rereadable(path)
    wanted = parse_range(frames) if frames else None
    sources = [open_input(path, rate_hz, wanted) for path in paths]
    lens = known_lens(camera, paths, sources)
    prior, said = lens.prior, lens.said
    built: dict[str, Any] = {
        "inputs": [Path(path).name for path in paths],
        "range": frames or "::",
        "lens_prior": {
            "source": prior.source,
            "focal_px": round(prior.camera.fx_px, 2),
            "sigma_focal": round(prior.sigma_focal, 4),
        },
    }
    if rate_hz is not None:
        built["rate_hz"] = rate_hz
    if lens.display_deg:
        built["display_deg"] = lens.display_deg
    counts = [source.count() for source in sources]
    known = None if None in counts else sum(count or 0 for count in counts)
    exact = frames is not None and frames.count(":") == 2
    limit = min(settings.keyframes.choose_above, settings.max_images)
    if exact or (known is not None and known <= limit):
        return Inputs(prior, known, built, said, paths, sources)
    if len(paths) > settings.max_images:
        raise InputError(f"{len(paths)} inputs; max_images is {settings.max_images}")
    figures = _measured(sources, prior.camera, settings, known)
    total = sum(map(len, figures))
    if total <= limit:  # a container that does not say how many frames it holds
        return Inputs(prior, total, built, said, paths, sources)
    chosen = keyframes.choose(figures, settings.max_images, settings.keyframes)
    if total <= settings.max_images and 2 * chosen.due > total:
        return Inputs(prior, total, built, said, paths, sources)
    again: list[FrameSource] = [
        open_input(path, rate_hz, ChosenFrames(indices=frozenset(index.tolist())))
        for path, index in zip(paths, chosen.index, strict=True)
    ]
    built["keyframes"] = {
        "frames": total,
        "due": chosen.due,
        "spacing": round(chosen.spacing, 3),
        "blurred": chosen.blurred,
    }
    given = [len(index) for index in chosen.index]
    said += _said(total, chosen, settings)
    return Inputs(prior, len(chosen), built, said, paths, again, given, sources)


def _measured(
    sources: Sequence[FrameSource], camera: Camera, settings: MappingSettings, total: int | None
) -> list[Figures]:
    with Progress("choosing keyframes, frames", total) as progress:

        def counted(source: FrameSource) -> Iterator[Frame]:
            for frame in source:
                yield frame
                progress.step()

        return [keyframes.measure(counted(s), camera, settings.keyframes) for s in sources]


def _said(total: int, chosen: Choice, settings: MappingSettings) -> list[str]:
    lines = [f"{total} frames; {len(chosen)} keyframes are used"]
    if chosen.due > len(chosen):
        lines[0] += (
            f" of {chosen.due} that were due: they stand {chosen.spacing:.2f} times as far apart "
            f"(max_images is {settings.max_images})"
        )
    if chosen.blurred:
        lines.append(f"{chosen.blurred} keyframes are blurred; no sharper frame shows what they do")
    return lines


def _stem(path: str) -> str:
    return Path(path).resolve().stem


def _check_names(paths: Sequence[str]) -> None:
    stems = [_stem(path) for path in paths]
    if len(set(stems)) != len(stems):
        twice = next(stem for stem in stems if stems.count(stem) > 1)
        raise InputError(f"two inputs are named '{twice}'; images are told apart by that name")


def _check_rereadable(path: str) -> None:
    where = Path(path)
    if where.exists() and not where.is_dir() and not where.is_file():
        raise InputError(
            f"{path}: a pipe or device cannot be read twice, which choosing frames needs; "
            "write it to a file first"
        )
