"""Points of images whose poses are known: COLMAP's triangulation, with the poses as they are."""

from __future__ import annotations

from pathlib import Path

from ground_station.arrays import F64
from ground_station.geometry import poses
from ground_station.map import colmap
from ground_station.map.colmap import pycolmap
from ground_station.mapping.sfm import adjustment

_ITERATIONS = 100
"""At most, of an adjustment of the points alone."""


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


def adjust_points(model: colmap.Reconstruction, *, loss_px: float, threads: int = 0) -> None:
    """Adjusts all points, with a Cauchy loss of scale `loss_px`, and neither poses nor camera."""
    options = adjustment.adjustment_options(loss_px, threads, _ITERATIONS)
    options.refine_rig_from_world = False
    options.refine_sensor_from_rig = False
    chosen = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        chosen.add_image(image_id)
    pycolmap.create_default_bundle_adjuster(options, chosen, model).solve()
