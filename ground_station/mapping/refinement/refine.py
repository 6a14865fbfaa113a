"""`refine_map`: what flights saw joins a map's graph, and a better map takes its place."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ground_station.arrays import F64
from ground_station.errors import MapError
from ground_station.map import colmap, landmarks, store
from ground_station.map.descriptors import rows_of
from ground_station.map.folder import carry_floorplan, kept_name, replacing
from ground_station.map.model import Model
from ground_station.map.observations import FlightObservations, landmarks_sha256
from ground_station.map.refined import FRAME_TIME, Refined
from ground_station.mapping.refinement import graph as graphs
from ground_station.mapping.refinement.adjust import adjust
from ground_station.mapping.refinement.chosen import Chosen, choose_frames, thin
from ground_station.mapping.refinement.graph import Graph
from ground_station.mapping.settings import MappingSettings
from ground_station.progress import Progress

_MOST_WORSE = 1.02
"""A larger deviation of the observations without the readout's shift says that there was none."""


@dataclass(frozen=True)
class Refinement:
    """What came of it: `report`, plain values, and where the old map is `kept`, if it is."""

    report: dict[str, Any]
    kept: Path | None = None


def refine_map(
    folder: str | Path,
    flights: Sequence[FlightObservations] = (),
    settings: MappingSettings | None = None,
    out: str | Path | None = None,
) -> tuple[store.Map, Refinement]:
    """Refines a map on disk by what flights saw of it, and writes it to `out` or in its place.

    Without flights the map's own observations are adjusted again. In place, the old map is kept
    beside it (NAME.before); the new one appears when it is whole. Raises `MapError` when the
    observations are those of another map, are in it already or do not fit it, and when the map has
    no observations itself."""
    settings, folder = settings or MappingSettings(), Path(folder)
    map_ = store.load(folder)
    settings = settings.with_noise(map_.info.noise_px)
    past = Refined.of(map_)
    _check_map(map_)
    chosen = [_choose(flight, map_, past, settings) for flight in flights]
    chosen = thin(chosen, settings.refine.max_frames)
    _check_new(chosen, map_)
    target = folder if out is None else Path(out)
    kept = kept_name(folder.absolute()) if out is None else None
    with replacing(target, kept) as part:
        refined, model, report = _refined(map_, past, chosen, settings)
        if out is not None:
            refined.info.name = target.absolute().name
            carry_floorplan(folder, part)
        colmap.write(colmap.from_arrays(model, map_.info.camera), part / "sparse")
        store.save_tables(part, refined)
    refined.folder = target
    return refined, Refinement(report, kept)


def straighten(map_: store.Map, settings: MappingSettings) -> tuple[store.Map, Model] | None:
    """A map that was just built, without the rolling shutter of its camera, and its model.

    Structure from motion takes each picture for a moment's. None where the camera has no readout
    time or the settings say so; raises `MapError` when the map cannot be adjusted.
    """
    if map_.info.camera.readout_s <= 0 or not settings.sfm.rolling_shutter:
        return None
    _check_map(map_)
    straight, model, _ = _refined(map_, Refined.of(map_), [], settings)
    return straight, model


def _refined(
    map_: store.Map, past: Refined, chosen: Sequence[Chosen], settings: MappingSettings
) -> tuple[store.Map, Model, dict[str, Any]]:
    """The map adjusted together with the chosen frames, its model, and what is told of it."""
    with Progress("adjustment, rounds", None) as progress:
        pixel_px, shutter = _keyframe_observations(map_, past, settings, progress.step)
        groups = past.groups(len(map_.keyframes))
        start = graphs.build_graph(map_, pixel_px, groups, chosen)
        graph = adjust(start, map_, settings, progress.step)
    _check_added(graph, past, chosen)
    refined = _assemble(map_, graph)
    report = {
        "images": len(refined.keyframes),
        "landmarks": len(refined.landmarks),
        "observations": len(refined.keyframes.landmark),
        "observations_dropped": len(start.model.point) - len(graph.model.point),
        "frames_dropped": len(start.group) - len(graph.group),
        "landmarks_dropped": len(map_.landmarks) - len(refined.landmarks),
        "rolling_shutter": shutter,
        "keyframes": _keyframe_report(map_, past, graph),
        "flights": [
            _flight_report(flight, start, graph, len(past.flights) + 1 + k)
            for k, flight in enumerate(chosen)
        ],
    }
    refined.info.refined = _table(map_, past, graph, report)
    return refined, graph.model, report


def _check_map(map_: store.Map) -> None:
    if len(map_.keyframes) < 2 or not len(map_.keyframes.landmark):
        raise MapError(f"{map_.folder}: it holds no keyframes' observations that could be adjusted")
    if len(np.unique(map_.landmarks.id)) != len(map_.landmarks):
        raise MapError(f"{map_.folder}: two of its landmarks have the same id")


def _choose(
    flight: FlightObservations, map_: store.Map, past: Refined, settings: MappingSettings
) -> Chosen:
    known = [landmarks_sha256(map_.landmarks), *past.landmarks_sha256]
    if flight.landmarks_sha256 not in known:
        raise MapError(
            f"the flight '{flight.name}' was localized in another map ('{flight.map}'), "
            f"whose landmarks are not those of {map_.folder}"
        )
    chosen = choose_frames(flight, map_, settings.refine)
    if not len(chosen):
        why = ", ".join(f"{reason}: {count}" for reason, count in chosen.left.items() if count)
        raise MapError(
            f"the flight '{flight.name}' has no frame that could be added"
            + (f" ({why})" if why else "")
        )
    return chosen


def _check_new(chosen: Sequence[Chosen], map_: store.Map) -> None:
    names = set(map_.keyframes.names)
    for flight in chosen:
        mine = {f"{flight.name}/{time_ns}" for time_ns in flight.time_ns.tolist()}
        if names & mine:
            raise MapError(f"the flight '{flight.name}' is in the map already, or given twice")
        names |= mine


def _check_added(graph: Graph, past: Refined, chosen: Sequence[Chosen]) -> None:
    for group, flight in enumerate(chosen, start=len(past.flights) + 1):
        if not (graph.group == group).any():
            raise MapError(
                f"the flight '{flight.name}' does not fit: each of its {len(flight)} frames lost "
                "most of its observations when all were adjusted together"
            )


def _keyframe_observations(
    map_: store.Map, past: Refined, settings: MappingSettings, on_round: Callable[[], None]
) -> tuple[F64, dict[str, Any]]:
    """The map's observations (O, 2), undistorted, at their frame's time unless that fits worse."""
    seen_px = map_.info.camera.undistort_to_pinhole(map_.keyframes.pixel_px)
    if past.runs:
        return seen_px, {"keyframes": 0, "undone": past.pixels_at == FRAME_TIME}
    moved_px, count = graphs.keyframe_pixels(map_, settings.refine.keyframe_gap_s)
    if not count:
        return seen_px, {"keyframes": 0, "undone": map_.info.camera.readout_s == 0}
    sigma = []
    for pixel_px in (seen_px, moved_px):
        graph = graphs.build_graph(map_, pixel_px, past.groups(len(map_.keyframes)), [])
        graph = graphs.solve(graph, settings, on_round)
        sigma.append(float(graphs.spread_px(graph)[0]))
    # Steady motion shears all observations alike, which a sheared model fits as well: then the
    # camera file is believed. It is not where the observations contradict it.
    better = sigma[1] < _MOST_WORSE * sigma[0]
    report = {
        "keyframes": count,
        "undone": better,
        "sigma_with_px": round(sigma[0], 4),
        "sigma_without_px": round(sigma[1], 4),
    }
    return (moved_px if better else seen_px), report


def _assemble(map_: store.Map, graph: Graph) -> store.Map:
    """The map in memory: old descriptors, everything else from the graph."""
    model, old = graph.model, map_.landmarks
    sigma_px = graph.sigma_px[graph.group_of_observations()]
    sigma_px = sigma_px * landmarks.sigma_px(model, sigma_px)
    made = landmarks.make_landmarks(model, np.zeros((len(model.point), 0), np.float32))
    kept = np.isin(old.id, model.point_id)
    covariance = landmarks.covariances(model, sigma_px)
    lm = dataclasses.replace(
        made,
        covariance_m2=covariance.astype(np.float32),
        descriptor=rows_of(old.descriptor, kept),
        spread=old.spread[kept],
        by_focal_m=old.by_focal_m[kept],
    )
    camera = map_.info.camera
    order = np.argsort(model.image, kind="stable")
    rays = (model.pixel_px[order] - model.pinhole[2:]) / model.pinhole[:2]
    offset = np.searchsorted(model.image[order], np.arange(len(model.names) + 1))
    keyframes = store.Keyframes(
        names=model.names,
        time_ns=graph.time_ns,
        wTc=model.wTc,
        offset=offset.astype(np.int64),
        landmark=model.point[order].astype(np.int32),
        pixel_px=camera.distort(rays).astype(np.float32),
    )
    modes = map_.modes.among(kept) if map_.modes is not None else None
    return store.Map(store.MapInfo(**vars(map_.info)), lm, keyframes, modes=modes)


def _keyframe_report(map_: store.Map, past: Refined, graph: Graph) -> dict[str, Any]:
    """How the map's own observations fitted and fit, and how far landmarks and keyframes moved."""
    built = graph.group_of_observations() == 0
    kept = np.isin(map_.landmarks.id, graph.model.point_id)
    pixel_px = map_.info.camera.undistort_to_pinhole(map_.keyframes.pixel_px)
    before = graphs.build_graph(map_, pixel_px, past.groups(len(map_.keyframes)), [])
    built_before = before.group_of_observations() == 0
    unit = "m" if map_.info.registered else map_.info.units
    moved = np.linalg.norm(graph.model.position - map_.landmarks.position_m[kept], axis=1)
    old = {name: k for k, name in enumerate(map_.keyframes.names)}
    pairs = [(old[n], k) for k, n in enumerate(graph.model.names) if n in old]
    a, b = np.array(pairs).T
    stepped = np.linalg.norm(map_.keyframes.wTc[a, :3, 3] - graph.model.wTc[b, :3, 3], axis=1)
    return {
        "sigma_px": round(float(graph.sigma_px[0]), 4),
        "median_before_px": _median(before.error_px()[built_before]),
        "median_px": _median(graph.error_px()[built]),
        "moved_unit": unit,
        "landmarks_moved_median": _median(moved),
        "landmarks_moved_p95": round(float(np.percentile(moved, 95)), 5),
        "keyframes_moved_median": _median(stepped),
    }


def _flight_report(flight: Chosen, start: Graph, graph: Graph, group: int) -> dict[str, Any]:
    mine, given = graph.group_of_observations() == group, start.group_of_observations() == group
    return {
        "name": flight.name,
        "frames": int((graph.group == group).sum()),
        "observations": int(mine.sum()),
        "observations_given": int(given.sum()),
        "observations_a_landmark": round(flight.observations_per_landmark, 2),
        "sigma_px": round(float(graph.sigma_px[group]), 4),
        "median_before_px": _median(start.error_px()[given]),
        "median_px": _median(graph.error_px()[mine]),
        "frames_left_out": {reason: count for reason, count in flight.left.items() if count},
    }


def _median(values: F64) -> float:
    return round(float(np.median(values)), 5) if len(values) else 0.0


def _table(map_: store.Map, past: Refined, graph: Graph, report: dict[str, Any]) -> dict[str, Any]:
    """`refined` of map.toml: the flights that are in the map, and the last run's report."""
    hashes = [*past.landmarks_sha256, landmarks_sha256(map_.landmarks)]
    undone = report["rolling_shutter"]["undone"]
    last = {name: value for name, value in report.items() if name != "flights"}
    frames = np.bincount(graph.group, minlength=len(graph.sigma_px))
    earlier = [  # they may have lost frames, too
        flight | {"frames": int(count)}
        for flight, count in zip(past.flights, frames[1:], strict=False)
    ]
    return Refined(
        runs=past.runs + 1,
        pixels_at=FRAME_TIME if undone else "",
        flights=[*earlier, *report["flights"]],
        landmarks_sha256=list(dict.fromkeys(hashes)),
        last=last,
    ).as_dict()
