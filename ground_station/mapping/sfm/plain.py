"""What COLMAP alone makes of pictures: the yardstick that our own builds are held against.

Its SIFT, every pair matched, its incremental structure from motion (Schönberger and Frahm, CVPR
2016), all with its defaults, the given lens held.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from ground_station.arrays import F64
from ground_station.geometry.camera import Camera
from ground_station.map import colmap
from ground_station.map.colmap_cameras import HALF_PIXEL

MAX_FEATURES = 2000
"""Of an image: about what a build of ours takes, too."""


@dataclass(frozen=True)
class PlainModel:
    """One model: the images' `names`, their poses `wTc` (K, 4, 4) and the median `depth` seen."""

    names: list[str]
    wTc: F64
    depth: float


def reconstruct(
    pictures: Path, camera: Camera, work: Path, seed: int, threads: int
) -> list[PlainModel]:
    """All models of the pictures in a folder, the largest first; none where there is no pair.

    `work` is a folder for COLMAP's own files; what an earlier run left there goes.
    """
    colmap.quiet()
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    lens = [
        camera.fx_px,
        camera.fy_px,
        camera.cx_px,
        camera.cy_px,
        *camera.distortion,
        0.0,
        0.0,
        0.0,
    ]
    lens[2] += HALF_PIXEL
    lens[3] += HALF_PIXEL
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model, reader.camera_params = "FULL_OPENCV", ",".join(map(str, lens))
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.sift.max_num_features, extraction.num_threads = MAX_FEATURES, threads or -1
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = threads or -1
    pycolmap.set_random_seed(seed)
    database, cpu = work / "database.db", pycolmap.Device.cpu
    pycolmap.extract_features(
        database, pictures, camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader,
        extraction_options=extraction, device=cpu,
    )  # fmt: skip
    pycolmap.match_exhaustive(database, matching_options=matching, device=cpu)
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.num_threads = seed, threads or -1
    options.ba_refine_focal_length = options.ba_refine_extra_params = False
    models = pycolmap.incremental_mapping(database, pictures, work, options)
    made = [_arrays(model) for model in models.values()]
    return sorted(made, key=lambda model: -len(model.names))


def _arrays(model: pycolmap.Reconstruction) -> PlainModel:
    images = sorted((i for i in model.images.values() if i.has_pose), key=lambda i: i.name)
    wTc = np.tile(np.eye(4), (len(images), 1, 1))
    depths = []
    for pose, image in zip(wTc, images, strict=True):
        cTw = image.cam_from_world().matrix()
        pose[:3, :3], pose[:3, 3] = cTw[:, :3].T, -cTw[:, :3].T @ cTw[:, 3]
        seen = [model.points3D[p.point3D_id].xyz for p in image.points2D if p.has_point3D()]
        if seen:
            depths.append(np.asarray(seen) @ cTw[2, :3] + cTw[2, 3])
    depth = float(np.median(np.concatenate(depths))) if depths else float("nan")
    return PlainModel([image.name for image in images], wTc, depth)
