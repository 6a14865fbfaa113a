"""Bundle adjustment by COLMAP, the lens held."""

from __future__ import annotations

from ground_station.arrays import F64, Bools
from ground_station.geometry.camera import Camera
from ground_station.map import colmap
from ground_station.map.colmap import pycolmap
from ground_station.map.model import Model

_POINTS_ITERATIONS = 100
"""At most, of an adjustment of the points alone."""


def _options(
    loss_px: float, threads: int, max_iterations: int = 50
) -> pycolmap.BundleAdjustmentOptions:
    """Of every bundle adjustment here: constant intrinsics, a Cauchy loss of scale `loss_px`."""
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = False
    options.refine_principal_point = False
    options.refine_extra_params = False
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = loss_px
    options.ceres.solver_options.num_threads = threads or -1
    options.ceres.solver_options.max_num_iterations = max_iterations
    options.ceres.solver_options.function_tolerance = 1e-6
    return options


def adjust(
    model: colmap.Reconstruction,
    *,
    loss_px: float,
    threads: int = 0,
    max_iterations: int = 50,
    tolerance: float = 1e-6,
) -> bool:
    """Bundle adjustment of all poses and points with a Cauchy loss of scale `loss_px`.

    It ends when a step lowers the cost by no more than the share `tolerance`. Returns whether that
    was within `max_iterations`.
    """
    options = _options(loss_px, threads, max_iterations)
    options.ceres.solver_options.function_tolerance = tolerance
    config = _all_images(model)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    summary = pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    return bool(summary.termination_type != pycolmap.BundleAdjustmentTerminationType.NO_CONVERGENCE)


def adjust_points(model: colmap.Reconstruction, *, loss_px: float, threads: int) -> None:
    """Adjusts all points, with a Cauchy loss of scale `loss_px`, and neither poses nor camera."""
    options = _options(loss_px, threads, _POINTS_ITERATIONS)
    options.refine_rig_from_world = False
    options.refine_sensor_from_rig = False
    pycolmap.create_default_bundle_adjuster(options, _all_images(model), model).solve()


def adjust_among_fixed(
    model: Model,
    fixed_points: Bools,
    fixed_images: Bools,
    camera: Camera,
    *,
    loss_px: float,
    threads: int = 0,
) -> tuple[F64, F64]:
    """Poses (K, 4, 4) and points (M, 3) of a model at the optimum.

    Fixed points (M,) and images (K,) stay, bit for bit, and give the gauge. Every point needs two
    observations. A Cauchy loss of scale `loss_px`; `threads` 0 takes one a core.
    """
    reconstruction = colmap.from_arrays(model, camera)
    options = _options(loss_px, threads)
    config = _all_images(reconstruction)
    for image_id in model.image_id[fixed_images].tolist():
        config.set_constant_rig_from_world_pose(reconstruction.images[image_id].frame_id)
    for point_id in model.point_id[fixed_points].tolist():
        config.add_constant_point(point_id)
    pycolmap.create_default_bundle_adjuster(options, config, reconstruction).solve()
    wTc, position = colmap.positions(reconstruction, model)
    position[fixed_points] = model.position[fixed_points]
    wTc[fixed_images] = model.wTc[fixed_images]
    return wTc, position


def _all_images(model: colmap.Reconstruction) -> pycolmap.BundleAdjustmentConfig:
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    return config
