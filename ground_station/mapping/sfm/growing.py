"""Bundle adjustment of new images among points and images that stay where they are."""

from __future__ import annotations

import pycolmap

from ground_station.arrays import F64, Bools
from ground_station.geometry.camera import Camera
from ground_station.map import colmap
from ground_station.map.model import Model
from ground_station.mapping.sfm import adjustment


def adjust_among_fixed(
    model: Model,
    fixed_points: Bools,
    fixed_images: Bools,
    camera: Camera,
    *,
    loss_px: float,
    threads: int = 0,
    max_iterations: int = 50,
) -> tuple[F64, F64]:
    """Poses (K, 4, 4) and points (M, 3) of a model at the optimum.

    Fixed points (M,) and images (K,) stay, bit for bit, and give the gauge. Every point needs two
    observations. A Cauchy loss of scale `loss_px`; `threads` 0 takes one a core.
    """
    reconstruction = colmap.from_arrays(model, camera)
    options = adjustment.adjustment_options(loss_px, threads, max_iterations)
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.image_id.tolist():
        config.add_image(image_id)
    for image_id in model.image_id[fixed_images].tolist():
        config.set_constant_rig_from_world_pose(reconstruction.images[image_id].frame_id)
    for point_id in model.point_id[fixed_points].tolist():
        config.add_constant_point(point_id)
    pycolmap.create_default_bundle_adjuster(options, config, reconstruction).solve()
    wTc, position = colmap.positions(reconstruction, model)
    position[fixed_points] = model.position[fixed_points]
    wTc[fixed_images] = model.wTc[fixed_images]
    return wTc, position
