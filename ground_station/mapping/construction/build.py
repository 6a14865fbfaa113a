"""From frames to a map: features, matches, structure from motion, landmarks."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ground_station.errors import MapError
from ground_station.geometry.camera import Camera
from ground_station.mapping import landmarks, store
from ground_station.mapping.construction.assembly import assemble
from ground_station.mapping.construction.cache import Cache
from ground_station.mapping.construction.content import structure_key
from ground_station.mapping.construction.images import extract
from ground_station.mapping.construction.structure import Structure, adjust_and_filter, reconstruct
from ground_station.mapping.construction.verification import match
from ground_station.mapping.construction.work import lasting
from ground_station.mapping.construction.workers import Threads, Workers
from ground_station.mapping.folder import replacing
from ground_station.mapping.settings import MappingSettings
from ground_station.mapping.sfm import colmap, colmap_files
from ground_station.recording.frames import Frame


def build_map(
    frames: Iterable[Frame],
    camera: Camera,
    settings: MappingSettings,
    out: str | Path,
    *,
    total: int | None = None,
    built: dict[str, Any] | None = None,
    cache: Cache | None = None,
    workers: Workers | None = None,
    held: ExitStack | None = None,
) -> store.Map:
    """Builds a map from frames in the folder `out`; a killed build leaves the old map there.

    `total` is the number of frames if known, `built` what map.toml shall say of the inputs. With a
    `cache`, what an earlier build has made is not made again, one that was killed included.
    `held` keeps the work of structure from motion until the caller has done with the map, too.
    `workers` extract and match, by default threads of this process. Raises `InputError` when there
    are fewer than two frames, `MapError` when sizes differ from the camera's, images do not
    overlap, or structure from motion fails.
    """
    out = Path(out)
    threads = settings.threads or os.cpu_count() or 1
    workers = workers or Threads(threads)
    stage_s: dict[str, float] = {}
    # What lasts is let go of only when the map is in its place.
    with ExitStack() as own, replacing(out) as folder:
        with _timed(stage_s, "features"):
            images = extract(frames, camera, settings, threads, total, cache=cache, workers=workers)
        with _timed(stage_s, "match"):
            pairs = match(images, camera, settings, threads, cache=cache, workers=workers)
        work = None
        if cache:
            print(f"{cache.figures} (cache {cache.folder})", flush=True)
            key = structure_key(images, pairs, camera, settings)
            keeper = own if held is None else held
            work = keeper.enter_context(lasting(cache.folder / "work", key))
        if work is None:
            work = folder / "work"
            work.mkdir()
        with _timed(stage_s, "sfm"), _colmap_in(work):
            structure = reconstruct(images, pairs, camera, settings, threads, work)
        with _timed(stage_s, "refine"):
            model = adjust_and_filter(structure.reconstruction, settings.sfm, threads)
        notes = _notes(len(images.names), len(model.names), structure)
        for note in notes:
            print(note, flush=True)
        map_ = assemble(model, images, camera, settings, out.name)
        map_.info.built = {
            **(built or {}),
            "images": len(images.names),
            "registered": len(model.names),
            "model_sizes": [len(model.names), *structure.sizes[1:]],
            "dropped": structure.dropped,
            "notes": notes,
            "sigma_px": landmarks.sigma_px(model),
            "reprojection_px": float(np.linalg.norm(landmarks.residuals_px(model), axis=1).mean()),
            "observations": len(model.point),
            "pairs_verified": len(pairs),
            "sparse_camera": "PINHOLE; key points are undistorted, the lens is in [camera]",
            "threads": threads,
            "workers": workers.name,
            **({"cache": asdict(cache.figures)} if cache else {}),
            "stage_s": {name: round(value, 3) for name, value in stage_s.items()},
            "settings": asdict(settings),
        }
        colmap.write(colmap.compact(structure.reconstruction), folder / "sparse")
        colmap_files.check(folder / "sparse")  # COLMAP does not say when the disk is full
        store.save_tables(folder, map_, quantise=settings.quantise)
        shutil.rmtree(folder / "work", ignore_errors=True)
    map_.folder = out
    return map_


@contextmanager
def _timed(stage_s: dict[str, float], name: str) -> Iterator[None]:
    start_s = time.monotonic()
    yield
    stage_s[name] = time.monotonic() - start_s


@contextmanager
def _colmap_in(work: Path) -> Iterator[None]:
    """Says in one line what COLMAP could not do: most likely, write its database there."""
    try:
        yield
    except RuntimeError as error:
        reason = " ".join(str(error).split())
        free_mb = shutil.disk_usage(work).free // 1_000_000
        raise MapError(
            f"{work}: structure from motion failed there, with {free_mb} MB free: {reason:.200}"
        ) from error


def _notes(images: int, registered: int, structure: Structure) -> list[str]:
    sizes, dropped = structure.sizes, structure.dropped
    others = f", models of sizes {[registered, *sizes[1:]]}" if sizes[1:] else ", one model"
    notes = [f"{registered} of {images} images registered{others}"]
    if dropped:
        shown = ", ".join(dropped[:5]) + (", …" if len(dropped) > 5 else "")
        notes.append(f"{len(dropped)} images dropped, far off their neighbours: {shown}")
    return notes + structure.notes
