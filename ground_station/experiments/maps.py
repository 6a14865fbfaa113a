"""Maps of flights, of as many images as a row asks for."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

from ground_station.experiments.declaration import MapSpec
from ground_station.experiments.material import flown
from ground_station.map import store
from ground_station.mapping.construction.build import build_map
from ground_station.mapping.construction.cache import Cache
from ground_station.mapping.registration.register import register_map
from ground_station.mapping.settings import MappingSettings


def build(
    spec: MapSpec,
    recording: Path | None,
    data: Path,
    settings: MappingSettings,
    folder: Path,
    cache: Path,
) -> store.Map:
    """The map of a flight's frames in `folder`, registered by its true poses.

    An error against it is then the localizer's and the landmarks', not the registration's. What a
    build that was killed has made is taken from the folder `cache`, as maps of the same frames do.
    """
    material = flown(spec.flight, recording, data)
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
    return register_map(folder, trajectory=material.truth, source="truth")[0]


def evenly(total: int, wanted: int) -> set[int]:
    """Which of `total` frames, from the first to the last, make `wanted` of them; 0: all."""
    if not 0 < wanted < total:
        return set(range(total))
    return {round(k * (total - 1) / max(1, wanted - 1)) for k in range(wanted)}


def moved(part: Path, folder: Path) -> None:
    """Puts what was made beside in its place; what lay there, a cut attempt, goes."""
    shutil.rmtree(folder, ignore_errors=True)
    part.replace(folder)
