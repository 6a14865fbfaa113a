"""Structure from motion: verified pairs become one model that can be believed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ground_station.errors import MapError
from ground_station.geometry.camera import Camera
from ground_station.mapping import landmarks
from ground_station.mapping.construction.consistency import plausible_frames
from ground_station.mapping.construction.images import Images
from ground_station.mapping.construction.matching import TwoView
from ground_station.mapping.settings import MappingSettings, SfmSettings
from ground_station.mapping.sfm import colmap
from ground_station.progress import Progress


@dataclass(frozen=True)
class Structure:
    """The largest model, `sizes` of all models in images as they came, and the images dropped."""

    reconstruction: colmap.Reconstruction
    sizes: list[int]
    dropped: list[str]


def reconstruct(
    images: Images,
    pairs: Mapping[tuple[int, int], TwoView],
    camera: Camera,
    settings: MappingSettings,
    threads: int,
    work: Path,
) -> Structure:
    """COLMAP's model of the images, in their order; `work` is a folder for its files.

    Raises `MapError` when structure from motion finds none.
    """
    colmap.write_database(work / "database.db", camera, images.names, images.pinhole_px, pairs)
    with Progress("structure from motion, images", len(images.names)) as progress:
        models = colmap.incremental(
            work / "database.db",
            work / "models",
            seed=settings.seed,
            threads=threads,
            images=len(images.names),
            refine_camera=settings.sfm.refine_camera,
            min_tri_angle_deg=settings.sfm.min_tri_angle_deg,
            on_image=progress.step,
        )
    dropped = _drop_implausible(models[0], images, settings.sfm.max_jump)
    return Structure(models[0], [model.num_reg_images() for model in models], dropped)


def adjust_and_filter(
    reconstruction: colmap.Reconstruction, sfm: SfmSettings, threads: int
) -> colmap.Model:
    """Filters and adjusts a model until what is kept fits; raises `MapError` when nothing does.

    Robust bundle adjustment, then observations above `max_error_px` and points below `min_track`
    or `min_tri_angle_deg` go; twice, because the first round's outliers bend the second's poses.
    """
    for _ in range(2):
        colmap.adjust(
            reconstruction, loss_px=sfm.loss_px, refine_camera=sfm.refine_camera, threads=threads
        )
        model = colmap.to_arrays(reconstruction)
        error = np.linalg.norm(landmarks.residuals_px(model), axis=1)
        bad = error > sfm.max_error_px
        colmap.drop_observations(
            reconstruction, model.image_id[model.image[bad]], model.feature[bad]
        )
        model = colmap.to_arrays(reconstruction)
        weak = (np.bincount(model.point, minlength=len(model.position)) < sfm.min_track) | (
            landmarks.largest_angles_deg(model) < sfm.min_tri_angle_deg
        )
        colmap.drop_points(reconstruction, model.point_id[weak])
    model = colmap.to_arrays(reconstruction)
    if not len(model.point_id):
        raise MapError(
            f"no landmark is seen by {sfm.min_track} images at {sfm.min_tri_angle_deg} degrees: "
            "the camera must move more between images"
        )
    return model


def _drop_implausible(
    reconstruction: colmap.Reconstruction, images: Images, max_jump: float
) -> list[str]:
    model = colmap.to_arrays(reconstruction)
    rays = model.position[model.point] - model.wTc[model.image, :3, 3]
    depth = float(np.median(np.linalg.norm(rays, axis=1))) if len(rays) else 0.0
    keep = plausible_frames(
        images.time_ns[model.image_id - 1], model.wTc[:, :3, 3], depth, max_jump
    )
    colmap.drop_images(reconstruction, model.image_id[~keep].tolist())
    return [name for name, kept in zip(model.names, keep, strict=True) if not kept]
