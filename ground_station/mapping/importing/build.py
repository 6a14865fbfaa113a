"""A map from a COLMAP model of others: its poses and camera, landmarks of our own features."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array

from ground_station.arrays import F64
from ground_station.errors import InputError, MapError
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera
from ground_station.geometry.epipolar import essential, sampson_px
from ground_station.map import colmap, landmarks, store
from ground_station.map.colmap import pycolmap
from ground_station.map.folder import replacing
from ground_station.map.model import Model
from ground_station.mapping.construction.assembly import assemble
from ground_station.mapping.construction.images import Images, extract
from ground_station.mapping.construction.matching import mutual_matches
from ground_station.mapping.construction.structure import drop_misfits
from ground_station.mapping.construction.verification import rules_of
from ground_station.mapping.construction.workers import Threads
from ground_station.mapping.settings import MappingSettings, SfmSettings
from ground_station.mapping.sfm import adjustment
from ground_station.mapping.sfm.database import write_database
from ground_station.mapping.sfm.foreign import ForeignModel
from ground_station.mapping.sfm.two_view import TwoView
from ground_station.progress import Progress
from ground_station.recording.frames import Frame


def triangulate(
    database: Path, wTc: F64, *, seed: int, min_tri_angle_deg: float, max_error_px: float
) -> colmap.Reconstruction:
    """A model of a database of `write_database`; image k has the pose `wTc[k]` (K, 4, 4).

    Schönberger and Frahm, CVPR 2016, section 4.3: tracks are made from verified matches, robustly,
    completed and merged. The poses are not touched.
    """
    colmap.quiet()
    pycolmap.set_random_seed(seed)
    loading = pycolmap.DatabaseCacheOptions()
    loading.load_all_images = True
    with pycolmap.Database.open(database) as opened:
        cache = pycolmap.DatabaseCache.create(opened, loading)
    model = pycolmap.Reconstruction()
    model.load(cache)
    for k, cTw in enumerate(poses.inverse(wTc)):
        model.frame(k + 1).rig_from_world = pycolmap.Rigid3d(cTw[:3])
        model.register_frame(k + 1)
    options = pycolmap.IncrementalTriangulatorOptions()
    options.random_seed = seed
    options.min_angle = min_tri_angle_deg
    options.complete_max_reproj_error = max_error_px
    options.merge_max_reproj_error = max_error_px
    graph = cache.correspondence_graph
    observations = pycolmap.ObservationManager(model, graph)
    triangulator = pycolmap.IncrementalTriangulator(graph, model, observations)
    for image_id in range(1, len(wTc) + 1):
        triangulator.triangulate_image(options, image_id)
    triangulator.complete_all_tracks(options)
    triangulator.merge_all_tracks(options)
    return model


_ROWS = 256


def covisible_pairs(
    points: Sequence[npt.NDArray[np.uint64]], *, least: int, most: int
) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, sorted: each image with the `most` that share most points with it.

    `points`, K arrays, are the different points that each image sees; pairs that share fewer than
    `least` are left out.
    """
    offset = np.cumsum([0, *map(len, points)])
    _, column = np.unique(np.concatenate([*points, np.empty(0, np.uint64)]), return_inverse=True)
    width = int(column.max(initial=0)) + 1
    ones = np.ones(len(column), np.int32)
    sees = csr_array((ones, column.ravel(), offset), shape=(len(points), width))
    pairs = set()
    for start in range(0, len(points), _ROWS):  # of a large model, all pairs fill the memory
        shared = (sees[start : start + _ROWS] @ sees.T).toarray()
        for i, row in enumerate(shared, start=start):
            row[i] = 0
            for j in np.argsort(-row, kind="stable")[:most].tolist():
                if row[j] >= least:
                    pairs.add((min(i, j), max(i, j)))
    return sorted(pairs)


def match(
    images: Images,
    wTc: F64,
    pairs: Sequence[tuple[int, int]],
    camera: Camera,
    settings: MappingSettings,
    threads: int,
) -> dict[tuple[int, int], TwoView]:
    """Matches of the pairs that fit the images' poses (K, 4, 4), where they are enough.

    A match is kept up to `sfm.max_error_px` off its epipolar lines: an observation further off
    would not stay in the map. Raises `MapError` when no pair has enough."""
    rules, matrix = rules_of(settings, far=False), camera.matrix

    def one(i: int, j: int) -> TwoView | None:
        first, second = images.features[i].descriptors, images.features[j].descriptors
        matches = mutual_matches(first, second, rules.ratio)
        E = essential(wTc[i], wTc[j])
        pixels = images.pinhole_px[i][matches[:, 0]], images.pinhole_px[j][matches[:, 1]]
        fits = sampson_px(*pixels, E, matrix) <= settings.sfm.max_error_px
        if fits.sum() < rules.min_inliers:
            return None
        return TwoView(matches[fits], E / np.linalg.norm(E), None, False)

    found: dict[tuple[int, int], TwoView] = {}
    with Progress("matching, pairs", len(pairs)) as progress:
        for pair, view in zip(pairs, Threads(threads).map(one, pairs), strict=True):
            if view is not None:
                found[pair] = view
            progress.step()
    if not found:
        raise MapError(
            f"no two of the {len(images.names)} images have {rules.min_inliers} matches that fit "
            "the model's poses: are these the pictures that it was made of?"
        )
    return found


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
        images = extract(frames, camera, settings, Threads(threads), len(model.names))
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
        colmap.write(colmap.from_arrays(found, camera), folder / "sparse")
        store.save_tables(folder, map_)
        shutil.rmtree(work)
    map_.folder = out
    return map_


def _settle(reconstruction: colmap.Reconstruction, sfm: SfmSettings, threads: int) -> Model:
    """Adjusts and filters the points as a build does, with the poses as they are.

    Images that see none of what is left go.
    """
    for _ in range(2):
        adjustment.adjust_points(reconstruction, loss_px=sfm.loss_px, threads=threads)
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
