"""`extend_map`: flights are localized in a map and join it, without moving what is registered."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from ground_station.arrays import F64, I64
from ground_station.errors import MapError
from ground_station.geometry.camera import Camera
from ground_station.localization.settings import LocalizerSettings, load_preset
from ground_station.map import colmap, store
from ground_station.map.folder import (
    carry_floorplan,
    check_target,
    content_id,
    kept_name,
    replacing,
    sizes,
)
from ground_station.map.model import model_of
from ground_station.map.observations import landmarks_sha256
from ground_station.map.refined import FRAME_TIME, Refined
from ground_station.map.store import Map
from ground_station.map_update.extension.frames import (
    Anchoring,
    Frames,
    Picked,
    describe,
    pick,
    thinned,
)
from ground_station.map_update.extension.joining import Grown, join, new_looks
from ground_station.map_update.extension.localizing import LocatedFlight, localize
from ground_station.map_update.extension.merging import merge, observation_descriptors
from ground_station.map_update.extension.structure import LOOSE_PX, Structure, weak_points
from ground_station.map_update.extension.tracks import joined, match_frames, pairs_to_match
from ground_station.map_update.missing import times_in_view
from ground_station.mapping.settings import MappingSettings
from ground_station.mapping.sfm.models import without_images, without_points
from ground_station.progress import Progress
from ground_station.recording.frames import FrameRange


def never_seen(map_: Map, wTc: F64, seen: I64, often: int) -> dict[str, int]:
    """How many landmarks were `often` in view of cameras (K, 4, 4), and how many of these not seen.

    `seen` are those that were. They are counted and not removed: another light hides, too.
    """
    expected = times_in_view(map_, wTc, map_.info.camera) >= often
    missed = expected.copy()
    missed[seen] = False
    return {"expected": int(expected.sum()), "never_seen": int(missed.sum())}


_FILTERS = 3
"""Rounds in which weak points and frames go: each may make others weak."""
_WITHOUT = ("other", "total")
"""Of a map's bytes: map.toml, which says how many they are, and the floor plan."""


@dataclass(frozen=True)
class Extension:
    """What came of it: `report`, plain values; `notes` of the inputs; where the old map is kept."""

    report: dict[str, Any]
    notes: list[str]
    kept: Path | None = None


def extend_map(
    folder: str | Path,
    inputs: Sequence[str | Path],
    settings: MappingSettings | None = None,
    *,
    camera: Camera | None = None,
    out: str | Path | None = None,
    rate_hz: float | None = None,
    frame_range: FrameRange | None = None,
) -> tuple[store.Map, Extension]:
    """Adds recordings, videos or folders to a map on disk; to `out`, or in its place.

    Each is localized in the map, with the default preset. Frames beside localized ones
    follow from what they share with them, new landmarks are triangulated, and old ones get further
    descriptors where they look otherwise. Landmarks and keyframes of the map stay where they are,
    and nothing is removed. In place, the old map is kept beside it (NAME.before); the new one
    appears when it is whole. Raises `MapError` when an input cannot be localized in the map, has
    another size or is in it already.
    """
    settings, folder = settings or MappingSettings(), Path(folder)
    localizer = load_preset("default")
    threads = settings.threads or os.cpu_count() or 1
    target = folder if out is None else Path(out)
    check_target(target.absolute())
    map_ = store.load(folder)
    settings = settings.with_noise(map_.info.noise_px)
    past = Refined.of(map_)
    _check_map(map_)
    flights = [
        localize(path, map_, localizer, camera=camera, rate_hz=rate_hz, frame_range=frame_range)
        for path in inputs
    ]
    _check_names(flights, map_)
    picked = [pick(flight, map_, settings) for flight in flights]
    _check_tied(flights, picked)
    picked = thinned(picked, settings.extend.max_frames)
    straight = past.pixels_at == FRAME_TIME
    frames = describe(flights, picked, map_, settings, threads, straight)
    notes = [note for flight in flights for note in flight.source.notes]
    structure = _structure(map_, flights, frames, settings, localizer, threads)
    with Progress("frames beside those localized", None) as progress:
        structure.grow(progress.step)
    grown, merged = _finish(structure, settings, localizer, straight)
    made = join(map_, grown, frames)
    flight_rows = [
        _flight_report(number, flight, one, grown, frames)
        for number, (flight, one) in enumerate(zip(flights, picked, strict=True))
    ]
    report = _report(map_, made, grown, flight_rows, merged, settings)
    made.info.refined = _with_flights(past, map_, flight_rows)
    kept = kept_name(folder.absolute()) if out is None else None
    with replacing(target, kept) as part:
        if out is not None:
            made.info.name = target.absolute().name
            carry_floorplan(folder, part)
        colmap.write(colmap.from_arrays(model_of(made), made.info.camera), part / "sparse")
        store.save_tables(part, made)
        report["bytes"] = [_bytes(folder), _bytes(part)]
        made.info.extended = _table(map_, {"of": content_id(folder), **report})
        store.save_info(part, made.info)
    made.folder = target
    return made, Extension(report, notes, kept)


def _structure(
    map_: store.Map,
    flights: Sequence[LocatedFlight],
    frames: Frames,
    settings: MappingSettings,
    localizer: LocalizerSettings,
    threads: int,
) -> Structure:
    """The localized frames, adjusted among the map's landmarks, and the tracks of all frames."""
    anchoring = Anchoring(map_, flights, frames, localizer)
    posed = ~np.isnan(frames.wTc[:, 0, 0])
    none = (np.empty(0, np.intp), np.empty(0, np.intp))
    seen = [
        anchoring.of(k, frames.wTc[k], frames.twist[k]) if posed[k] else none
        for k in range(len(frames))
    ]
    shown = [landmark for _, landmark in seen]
    pairs = pairs_to_match(frames, shown, len(map_.landmarks), settings)
    verified = match_frames(frames, pairs, map_.info, settings, threads)
    tracks = joined(frames.offset, verified)
    structure = Structure(map_, frames, tracks, anchoring, settings, localizer.recovery, threads)
    for k in np.flatnonzero(posed).tolist():
        structure.anchor(k, *seen[k])
    structure.assign()
    structure.adjust(LOOSE_PX)
    structure.assign()
    structure.triangulate()
    structure.adjust(LOOSE_PX)
    return structure


def _finish(
    structure: Structure, settings: MappingSettings, localizer: LocalizerSettings, straight: bool
) -> tuple[Grown, tuple[int, int]]:
    """The optimum of all that joins, without what does not fit; how many tracks were merged."""
    map_, gate_px = structure.map, settings.sfm.max_error_px
    if straight and map_.info.camera.readout_s > 0:
        structure.straighten()
    for _ in range(2):
        structure.assign()
        structure.forget_doubtful()
        structure.triangulate()
        structure.adjust(gate_px)
    merged = merge(structure, gate_px, settings.extend.merge_px, localizer.projection)
    structure.adjust(gate_px)
    model, count = structure.model(gate_px), len(map_.landmarks)
    for _ in range(_FILTERS):
        few = (
            np.bincount(model.image, minlength=len(model.names)) < settings.extend.min_observations
        )
        model = without_images(model, few)
        new = model.point_id - 1 >= count
        model = without_points(model, weak_points(model, new, settings))
    if not len(model.names):
        raise MapError(
            f"no frame keeps {settings.extend.min_observations} observations that fit the map: "
            "nothing joins it"
        )
    landmark = np.where(model.point_id - 1 < count, model.point_id - 1, -1)
    descriptor = observation_descriptors(model, structure.frames)
    old = landmark[model.point] >= 0
    looks = new_looks(map_, landmark[model.point[old]], descriptor[old], settings)
    return Grown(model, landmark, descriptor, looks), merged


def _check_map(map_: store.Map) -> None:
    if not len(map_.landmarks) or not len(map_.keyframes):
        raise MapError(f"{map_.folder}: it holds no keyframes in which a flight could be found")
    if len(np.unique(map_.landmarks.id)) != len(map_.landmarks):
        raise MapError(f"{map_.folder}: two of its landmarks have the same id")


def _check_names(flights: Sequence[LocatedFlight], map_: store.Map) -> None:
    names = [flight.name for flight in flights]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise MapError(f"two inputs are named '{twice}'; keyframes are told apart by that name")
    held = set(map_.keyframes.names)
    for flight in flights:
        if any(f"{flight.name}/{time_ns}" in held for time_ns in flight.time_ns.tolist()):
            raise MapError(f"{flight.path}: the flight '{flight.name}' is in the map already")


def _check_tied(flights: Sequence[LocatedFlight], picked: Sequence[Picked]) -> None:
    for flight, one in zip(flights, picked, strict=True):
        if not np.isfinite(one.wTc).all(axis=(1, 2)).any():
            why = ", ".join(f"{reason}: {count}" for reason, count in one.left.items())
            raise MapError(
                f"{flight.path}: none of its {len(flight.seen)} tracked frames ties it to the map"
                + (f" ({why})" if why else "")
            )


def _flight_report(
    number: int, flight: LocatedFlight, one: Picked, grown: Grown, frames: Frames
) -> dict[str, Any]:
    joined_ = grown.model.image_id - 1
    mine = frames.flight[joined_] == number
    known = np.isfinite(frames.wTc[joined_[mine]]).all(axis=(1, 2))
    return {
        "name": flight.name,
        "input": flight.path.name,
        "frames_read": len(flight.time_ns),
        "frames_localized": flight.localized,
        "frames_tried": int((frames.flight == number).sum()),
        "frames": int(mine.sum()),
        "frames_not_localized": int((~known).sum()),
        "observations": int(mine[grown.model.image].sum()),
        "frames_left_out": one.left,
    }


def _report(
    map_: store.Map,
    made: store.Map,
    grown: Grown,
    flights: list[dict[str, Any]],
    merged: tuple[int, int],
    settings: MappingSettings,
) -> dict[str, Any]:
    """Figures before and after, as pairs, and what became of the observations."""
    model, looks = grown.model, grown.looks
    count = [len(each.modes) if each.modes is not None else 0 for each in (map_, made)]
    seen = grown.landmark[grown.landmark >= 0]
    often = settings.extend.expected_often
    return {
        "keyframes": [len(map_.keyframes), len(made.keyframes)],
        "landmarks": [len(map_.landmarks), len(made.landmarks)],
        "modes": count,
        "observations": [len(map_.keyframes.landmark), len(made.keyframes.landmark)],
        "flights": flights,
        "landmarks_seen_again": looks.seen,
        "observations_as_known": looks.near,
        "observations_unlike": looks.far,
        "landmarks_without_room": looks.full,
        "tracks_that_were_landmarks": merged[0],
        "tracks_merged": merged[1],
        "age": {"often": often, **never_seen(map_, model.wTc, seen, often)},
    }


def _with_flights(past: Refined, map_: store.Map, flights: list[dict[str, Any]]) -> dict[str, Any]:
    """`refined` of map.toml: keyframes go by flights, and what older ones saw is of this map."""
    rows = [
        {"name": flight["name"], "frames": flight["frames"], "observations": flight["observations"]}
        for flight in flights
    ]
    hashes = [*past.landmarks_sha256, landmarks_sha256(map_.landmarks)]
    return dataclasses.replace(
        past,
        flights=[*past.flights, *rows],
        landmarks_sha256=list(dict.fromkeys(hashes)),
    ).as_dict()


def _bytes(folder: Path) -> int:
    return sum(size for part, size in sizes(folder).items() if part not in _WITHOUT)


def _table(map_: store.Map, report: dict[str, Any]) -> dict[str, Any]:
    """`extended` of map.toml: every run with its time, inputs and figures, the last one last.

    `of` is the map that was extended, by its content.
    """
    when = datetime.now(UTC).isoformat(timespec="seconds")
    return {"runs": [*map_.info.extensions, {"time": when, **report}]}
