"""COLMAP's global structure from motion: all rotations first, then all positions at once."""

from __future__ import annotations

import shutil
from pathlib import Path

import pycolmap

from ground_station.map import colmap
from ground_station.mapping.sfm.incremental import Wanted
from ground_station.mapping.sfm.snapshots import Snapshots

_DONE = "done"


def reconstruct(database: Path, work: Path, wanted: Wanted) -> list[colmap.Reconstruction]:
    """The models; none when it fails. What is finished in the folder `work` is not done again.

    Pan, Baráth, Pollefeys and Schönberger, "Global structure-from-motion revisited", ECCV 2024
    (GLOMAP). There is no way to stop in between, so a killed build begins it again.
    """
    colmap.quiet()
    finished = Snapshots(work / "models")
    if (work / _DONE).exists():
        found = [finished.load(name) for name in finished.names()]
        if all(found):
            return [entry[0] for entry in found if entry is not None]
        (work / _DONE).unlink()
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = wanted.seed
    options.num_threads = wanted.threads or -1
    options.min_model_size = wanted.smallest
    mapper = options.mapper
    mapper.bundle_adjustment.refine_focal_length = False
    mapper.bundle_adjustment.refine_principal_point = False
    mapper.bundle_adjustment.refine_extra_params = False
    mapper.min_tri_angle_deg = wanted.min_tri_angle_deg
    mapper.global_positioning.use_gpu = False
    pycolmap.set_random_seed(wanted.seed)
    raw = work / "raw"
    shutil.rmtree(raw, ignore_errors=True)
    raw.mkdir(parents=True)
    models = list(pycolmap.global_mapping(database, raw, raw, options).values())
    shutil.rmtree(raw)
    for number, model in enumerate(models):
        model.tear_down()  # images without a pose go
        finished.save(f"{number:02d}", model)
    (work / _DONE).touch()
    return models
