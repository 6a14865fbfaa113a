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
from ground_station.map import colmap, landmarks
from ground_station.map.colmap import described

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
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model, lens = described(camera)
    reader.camera_params = ",".join(map(str, lens))
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


def _arrays(reconstruction: colmap.Reconstruction) -> PlainModel:
    model = colmap.to_arrays(reconstruction)
    order = np.argsort(model.names)
    depth = float(np.median(landmarks.in_cameras(model)[:, 2]))
    return PlainModel([model.names[k] for k in order], model.wTc[order], depth)
