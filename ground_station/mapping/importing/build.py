"""A map from a COLMAP model of others: its poses and camera, landmarks of our own features."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ground_station.errors import InputError, MapError
from ground_station.geometry.camera import Camera
from ground_station.map import colmap, landmarks, store
from ground_station.map.folder import replacing
from ground_station.map.model import Model
from ground_station.mapping.construction.assembly import assemble
from ground_station.mapping.construction.images import extract
from ground_station.mapping.construction.structure import drop_misfits
from ground_station.mapping.importing.matching import covisible_pairs, match
from ground_station.mapping.settings import MappingSettings, SfmSettings
from ground_station.mapping.sfm.database import write_database
from ground_station.mapping.sfm.foreign import ForeignModel
from ground_station.mapping.sfm.triangulation import adjust_points, triangulate
from ground_station.recording.frames import Frame

_NAMED = 5


def import_model(
    model: ForeignModel,
    frames: Iterable[Frame],
    camera: Camera,
    settings: MappingSettings,
    out: str | Path,
    *,
    built: dict[str, Any] | None = None,
) -> store.Map:
    """A map of a model's images in the folder `out`; who kills it leaves the old map there.

    `frames` are the images, under the model's names; of `camera` they were taken. Landmarks are
    made again, because a localizer needs them with its own descriptors: features of every image,
    matched between images that share points of the model, kept where they fit its poses, and
    triangulated. Coordinates and scale stay the model's, which knows no units, so the map is not
    registered. Raises `InputError` and `MapError` with one line.
    """
    out = Path(out)
    threads = settings.threads or os.cpu_count() or 1
    started_s = time.monotonic()
    with replacing(out) as folder:
        images = extract(frames, camera, settings, threads, len(model.names))
        place = {name: k for k, name in enumerate(model.names)}
        rows = [place[name] for name in images.names]
        wTc = model.wTc[rows]
        limits = settings.importing
        pairs = covisible_pairs(
            [model.points[row] for row in rows], least=limits.min_shared, most=limits.covisible
        )
        if not pairs:
            raise InputError(
                f"no two of the {len(rows)} images share {limits.min_shared} points of the model: "
                "which of them see the same is not known"
            )
        verified = match(images, wTc, pairs, camera, settings, threads)
        work = folder / "work"
        work.mkdir()
        write_database(work / "database.db", camera, images.names, images.pinhole_px, verified)
        reconstruction = triangulate(
            work / "database.db",
            wTc,
            seed=settings.seed,
            min_tri_angle_deg=settings.sfm.min_tri_angle_deg,
            max_error_px=settings.sfm.max_error_px,
        )
        found = _settle(reconstruction, settings.sfm, threads)
        notes = _notes(model.names, images.names, found.names)
        map_ = assemble(found, images, camera, settings, out.name)
        map_.info.built = {
            **(built or {}),
            "images": len(model.names),
            "registered": len(found.names),
            "model_sizes": [len(found.names)],
            "notes": notes,
            "sigma_px": landmarks.sigma_px(found),
            "reprojection_px": float(np.linalg.norm(landmarks.residuals_px(found), axis=1).mean()),
            "observations": len(found.point),
            "pairs_verified": len(verified),
            "sparse_camera": "the one in [camera]; key points are those of the pictures",
            "threads": threads,
            "stage_s": {"import": round(time.monotonic() - started_s, 3)},
            "settings": asdict(settings),
        }
        colmap.write(colmap.compact(reconstruction), folder / "sparse")
        store.save_tables(folder, map_, quantise=settings.quantise)
        shutil.rmtree(work)
    map_.folder = out
    return map_


def _settle(reconstruction: colmap.Reconstruction, sfm: SfmSettings, threads: int) -> Model:
    """Adjusts and filters the points as a build does, with the poses as they are.

    Images that see none of what is left go.
    """
    for _ in range(2):
        adjust_points(reconstruction, loss_px=sfm.loss_px, threads=threads)
        model = drop_misfits(reconstruction, sfm)
    if not len(model.point_id):
        raise MapError(
            f"no landmark is seen by {sfm.min_track} images at {sfm.min_tri_angle_deg} degrees "
            f"within {sfm.max_error_px} px of the model's poses"
        )
    observations = np.bincount(model.image, minlength=len(model.names))
    if not observations.all():
        colmap.drop_images(reconstruction, model.image_id[observations == 0])
        model = colmap.to_arrays(reconstruction)
    return model


def _notes(wanted: list[str], given: list[str], kept: list[str]) -> list[str]:
    notes = [f"{len(kept)} of the model's {len(wanted)} images are in the map"]
    missing = sorted(set(wanted) - set(given))
    if missing:
        notes.append(f"{len(missing)} have no picture: {_some(missing)}")
    blind = sorted(set(given) - set(kept))
    if blind:
        notes.append(f"{len(blind)} see no landmark and are left out: {_some(blind)}")
    return notes


def _some(names: list[str]) -> str:
    return ", ".join(names[:_NAMED]) + (", …" if len(names) > _NAMED else "")
