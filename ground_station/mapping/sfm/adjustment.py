"""Bundle adjustment by COLMAP, the lens held."""

from __future__ import annotations

from ground_station.map import colmap
from ground_station.map.colmap import pycolmap


def adjustment_options(
    loss_px: float, threads: int, max_iterations: int
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
    options = adjustment_options(loss_px, threads, max_iterations)
    options.ceres.solver_options.function_tolerance = tolerance
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    summary = pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    return bool(summary.termination_type != pycolmap.BundleAdjustmentTerminationType.NO_CONVERGENCE)
