"""The frames of flights that may join a map: which ones, and what they show."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ground_station.arrays import F64, I64, Indices
from ground_station.errors import MapError
from ground_station.features.extractor import Features
from ground_station.geometry.camera import Camera
from ground_station.localization import matching
from ground_station.localization.attempt import Conditions, Stopwatch
from ground_station.localization.kinematics import Kinematics
from ground_station.localization.settings import LocalizerSettings
from ground_station.map.store import Map, check_features
from ground_station.map_update.extension.localizing import LocatedFlight
from ground_station.mapping.construction.images import extract_features, extractor_of
from ground_station.mapping.construction.matching import mutual_matches
from ground_station.mapping.construction.workers import Threads
from ground_station.mapping.refinement import shutter
from ground_station.mapping.refinement.chosen import by_lens, choose_frames
from ground_station.mapping.settings import MappingSettings
from ground_station.progress import Progress
from ground_station.recording.frames import Frame

_ENOUGH_MATCHES = 20
"""Fewer matches do not tell how far a picture moved."""


@dataclass(frozen=True)
class Frames:
    """K frames in the order of their flights and times, described.

    `names`; `flight` (K,), which of the flights; `time_ns` (K,); `wTc` (K, 4, 4), the localizer's,
    NaN where it had none; `twist` (K, 6), rad/s then m/s, 0 where it is unknown or the map does not
    undo the readout. Feature f of frame k is row offset[k] + f of `pixel_px` (N, 2), undistorted
    pixels of the map's camera, and `row_s` (N,), when its row was exposed after the frame's time.
    """

    names: list[str]
    flight: I64
    time_ns: I64
    wTc: F64
    twist: F64
    features: list[Features]
    offset: I64
    pixel_px: F64
    row_s: F64

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True)
class Picked:
    """Times (K,) of a flight's frames, increasing, and their poses (K, 4, 4), NaN if unknown.

    `left` counts tracked frames by why they were left out.
    """

    time_ns: I64
    wTc: F64
    left: dict[str, int]


def pick(flight: LocatedFlight, map_: Map, settings: MappingSettings) -> Picked:
    """Tracked frames whose view has changed, and of stretches without any one every so often.

    The latter show what the map does not know, or not in this light; neighbours that are localized
    may tie them to it.
    """
    chosen = choose_frames(flight.seen, map_, settings.refine)
    known = set(flight.seen.time_ns.tolist())
    gap_ns = round(settings.extend.lost_interval_s * 1e9)
    lost, last = [], None
    for time_ns in flight.time_ns.tolist():
        if time_ns in known:
            last = time_ns
        elif last is None or time_ns - last >= gap_ns:
            lost.append(time_ns)
            last = time_ns
    time_ns = np.concatenate([chosen.time_ns, np.array(lost, np.int64)])
    wTc = np.concatenate([chosen.wTc, np.full((len(lost), 4, 4), np.nan)])
    order = np.argsort(time_ns)
    return Picked(time_ns[order], wTc[order], {why: n for why, n in chosen.left.items() if n})


def thinned(picked: Sequence[Picked], most: int) -> list[Picked]:
    """The same with at most `most` frames in all, taken evenly; at least two of each flight."""
    total = sum(len(one.time_ns) for one in picked)
    if total <= most:
        return list(picked)
    result = []
    for one in picked:
        count = min(len(one.time_ns), max(2, most * len(one.time_ns) // total))
        kept = np.linspace(0, len(one.time_ns) - 1, count).round().astype(np.int64)
        left = one.left | {"above max_frames": len(one.time_ns) - count}
        result.append(Picked(one.time_ns[kept], one.wTc[kept], left))
    return result


def describe(
    flights: Sequence[LocatedFlight],
    picked: Sequence[Picked],
    map_: Map,
    settings: MappingSettings,
    threads: int,
    straight: bool,
) -> Frames:
    """The picked frames with their features; reads the inputs once more.

    `straight`: the map's observations are where a global shutter would have seen them, so that
    these shall be, too. A frame without a pose that shows what the one before did is left out.
    Raises `MapError` when the map was built with features that are not here."""
    rows: list[tuple[str, int, int, F64, F64, Features, F64, F64]] = []
    total = sum(len(one.time_ns) for one in picked)
    with Progress("features, frames", total) as progress:
        for number, (flight, one) in enumerate(zip(flights, picked, strict=True)):
            twist = _twists(flight, one, settings, straight)
            last: Features | None = None
            for frame, features in _described(flight, one, map_, settings, threads):
                progress.step()
                k = int(np.searchsorted(one.time_ns, frame.time_ns))
                lost = not np.isfinite(one.wTc[k]).all()
                moved = settings.extend.min_moved_px
                if lost and last is not None and _stands(last, features, settings, moved):
                    continue
                last = features
                features, pixel_px = _in_map(features, flight.camera, map_.info.camera)
                row_s = shutter.row_times_s(features.keypoints_px[:, 1], flight.camera)
                name = f"{flight.name}/{frame.time_ns}"
                rows.append(
                    (name, number, frame.time_ns, one.wTc[k], twist[k], features, pixel_px, row_s)
                )
    if not rows:
        raise MapError("the inputs gave no frame a second time: were they changed meanwhile?")
    names, numbers, time_ns, wTc, twists, features_, pixels, row_times = zip(*rows, strict=True)
    return Frames(
        names=list(names),
        flight=np.array(numbers, np.int64),
        time_ns=np.array(time_ns, np.int64),
        wTc=np.stack(wTc),
        twist=np.stack(twists),
        features=list(features_),
        offset=np.cumsum([0, *map(len, features_)], dtype=np.int64),
        pixel_px=np.concatenate(pixels),
        row_s=np.concatenate(row_times),
    )


def _twists(flight: LocatedFlight, one: Picked, settings: MappingSettings, straight: bool) -> F64:
    """Twists (K, 6) of the picked frames, from all the frames that were tracked around them."""
    result = np.zeros((len(one.time_ns), 6))
    if not straight or flight.camera.readout_s == 0:
        return result
    seen, refine = flight.seen, settings.refine
    twist = shutter.twists(seen.time_ns, seen.wTc, refine.twist_reach_s, refine.twist_gap_s)
    place = np.minimum(np.searchsorted(seen.time_ns, one.time_ns), len(seen) - 1)
    known = seen.time_ns[place] == one.time_ns
    result[known] = np.nan_to_num(twist[place[known]])
    return result


def _described(
    flight: LocatedFlight, one: Picked, map_: Map, settings: MappingSettings, threads: int
) -> Iterator[tuple[Frame, Features]]:
    wanted = set(one.time_ns.tolist())
    of_map = dataclasses.replace(settings, features=map_.info.features)

    extractor = extractor_of(of_map)
    check_features(map_.info, extractor.name, extractor.sha256)

    def describe_one(frame: Frame) -> tuple[Frame, Features]:
        return frame, extract_features(of_map, frame.image)

    yield from Threads(threads).map(
        describe_one, ((frame,) for frame in flight.source if frame.time_ns in wanted)
    )


def _stands(before: Features, after: Features, settings: MappingSettings, moved_px: float) -> bool:
    """Whether two pictures show the same from the same place, by their matches' median way."""
    matches = mutual_matches(before.descriptors, after.descriptors, settings.match.ratio)
    if len(matches) < _ENOUGH_MATCHES:
        return False
    way = before.keypoints_px[matches[:, 0]] - after.keypoints_px[matches[:, 1]]
    return bool(np.median(np.linalg.norm(way, axis=1)) < moved_px)


def _in_map(features: Features, camera: Camera, of_map: Camera) -> tuple[Features, F64]:
    """Features that the map's lens can express, and where (N, 2), undistorted pixels."""
    pixel_px, keep = by_lens(features.keypoints_px, camera, of_map)
    keep &= np.isfinite(features.descriptors).all(axis=1)
    return features.where(keep), pixel_px[keep]


_RADIUS_PX = 8.0
"""A landmark is looked for so near to where a localized frame's pose projects it."""
_ALL = 10_000


class Anchoring:
    """The localizer's own matching, of all of a frame's features."""

    def __init__(
        self,
        map_: Map,
        flights: Sequence[LocatedFlight],
        frames: Frames,
        settings: LocalizerSettings,
    ) -> None:
        settings = replace(settings, pose=replace(settings.pose, max_observations=_ALL))
        self._matchers = [
            matching.Matcher(map_, flight.camera, settings, flight.distance_scale)
            for flight in flights
        ]
        self._frames = frames

    def of(self, k: int, wTc: F64, twist: F64) -> tuple[Indices, Indices]:
        """Features (N,) of frame k at wTc (4, 4) with a twist (6,), and their landmarks (N,)."""
        frames = self._frames
        matcher = self._matchers[int(frames.flight[k])]
        seen = matching.describe(frames.features[k], matcher.camera, Conditions())
        expected = Kinematics(int(frames.time_ns[k]), wTc, twist, np.zeros((12, 12)))
        matches = matcher.match(seen, expected, _RADIUS_PX, Stopwatch())
        return matches.feature, matches.landmark
