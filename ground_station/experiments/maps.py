"""Maps of flights, of as many images as a row asks for."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ground_station.arrays import F64
from ground_station.experiments.declaration import FlightDeclaration, MapSpec
from ground_station.experiments.flights import points_of
from ground_station.experiments.material import flown
from ground_station.files import write_json
from ground_station.geometry.alignment import Alignment, spread_out
from ground_station.map import store
from ground_station.mapping.construction.build import build_map
from ground_station.mapping.construction.cache import Cache
from ground_station.mapping.registration.observations import PointObservations, read_pairs
from ground_station.mapping.registration.register import find_similarity, register_map
from ground_station.mapping.settings import MappingSettings


def build(
    spec: MapSpec,
    recording: Path | None,
    data: Path,
    settings: MappingSettings,
    folder: Path,
    cache: Path,
    lens: Path | None = None,
) -> store.Map:
    """The map of a flight's frames in `folder`, registered by its true poses or by clicked points.

    By true poses an error against it is the localizer's and the landmarks', not the registration's;
    by points the registration's share is told apart (`displacement`). Its camera is the recording's
    own, or what the file `lens` says. What a build that was killed
    has made is taken from the folder `cache`, as maps of the same frames do.
    """
    material = flown(spec.flight, recording, data, lens)
    total = material.frames.count()
    if total is None:
        total = sum(1 for _ in material.frames)
    chosen = evenly(total, spec.images)
    with Cache(cache, int(settings.cache_gb * 1e9)) as kept:
        build_map(
            (frame for k, frame in enumerate(material.frames) if k in chosen),
            material.camera,
            replace(settings, features=spec.features),
            folder,
            total=len(chosen),
            cache=kept if settings.cache_gb else None,
        )
    if not (recording and spec.flight.clicked):
        return register_map(folder, trajectory=material.truth, source="truth")[0]
    true = find_similarity(store.load(folder), trajectory=material.truth).fit
    clicks = clicked(read_pairs(points_of(recording)), spec.flight, spec.seed)
    registered, found = register_map(folder, observations=clicks, source="clicks")
    write_json(folder / _DISPLACEMENT, {"true": _plain(true), "found": _plain(found.fit)})
    return registered


def clicked(known: PointObservations, walk: FlightDeclaration, seed: int) -> PointObservations:
    """As many of the points as a walk asks for, far from each other, clicked and measured.

    A person errs otherwise in every building: with one draw for all, theirs would be one error.
    """
    rng = np.random.default_rng([seed, *walk.scene.encode()])
    places = known.world_m
    chosen = spread_out(places, walk.clicked)
    kept = np.isin(known.point, chosen)
    number = np.full(len(places), -1, np.int64)
    number[chosen] = np.arange(len(chosen))
    pixel_px = known.pixel_px[kept]
    return PointObservations(
        points=[known.points[k] for k in chosen],
        world_m=places[chosen] + rng.normal(0, _MEASURED_M, (len(chosen), 3)),
        point=number[known.point[kept]],
        image=[name for name, keep in zip(known.image, kept.tolist(), strict=True) if keep],
        pixel_px=pixel_px + rng.normal(0, _CLICKED_PX, pixel_px.shape),
    )


def displacement(map_: store.Map, places_m: F64) -> F64 | None:
    """By how much the registration alone displaces places (N, 3), metres; None: by the truth's."""
    path = map_.folder / _DISPLACEMENT if map_.folder else None
    if path is None or not path.is_file():
        return None
    true, found = (Alignment(scale=one["scale"], rotation=np.array(one["rotation"]),
                             translation=np.array(one["translation"]))
                   for one in map(json.loads(path.read_text()).get, ("true", "found")))  # fmt: skip
    model = (places_m - true.translation) @ true.rotation / true.scale
    return np.asarray(np.linalg.norm(found.apply(model) - places_m, axis=1))


def _plain(fit: Alignment) -> dict[str, Any]:
    return {
        "scale": fit.scale,
        "rotation": fit.rotation.tolist(),
        "translation": fit.translation.tolist(),
    }


_DISPLACEMENT = "displacement.json"
_CLICKED_PX, _MEASURED_M = 1.0, 0.01
"""Deviations, along each axis, of a person's click and of a place measured with a tape."""


def evenly(total: int, wanted: int) -> set[int]:
    """Which of `total` frames, from the first to the last, make `wanted` of them; 0: all."""
    if not 0 < wanted < total:
        return set(range(total))
    return {round(k * (total - 1) / max(1, wanted - 1)) for k in range(wanted)}
