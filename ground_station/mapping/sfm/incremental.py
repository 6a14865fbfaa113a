"""COLMAP's incremental structure from motion, in batches that a killed build goes on from.

Schönberger and Frahm, "Structure-from-motion revisited", CVPR 2016. The order of the steps is that
of COLMAP's own pipeline; the steps themselves are COLMAP's. What is added: the work is cut where
the whole model was just adjusted. There the model goes to disk, and the next batch starts from
what it reads there, whether the program ran on or was killed meanwhile. So both ways give one map.

With one seed two runs differ by what COLMAP's threads add up in another order: bundle adjustment
sums in the order in which threads finish, in the last bits of a number. An observation whose error
is that near to a limit may fall on the other side of it."""

from __future__ import annotations

import copy
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from ground_station.arrays import F64
from ground_station.map import colmap
from ground_station.mapping.sfm.snapshots import Snapshots

_BATCH = 10
"""A batch has at least so many new images: to begin one takes a pass over all key points."""
_LEVELS = 5
"""How often the demands on the first pair are halved, in turn its matches and its angle."""
_STUBBORN = 30
"""After so many images in a row that do not fit, a small model is given up."""
_GIVEN_UP = 20
"""After so many further models that stayed small, what is left is in pieces."""
_DONE = "done"


@dataclass(frozen=True)
class Wanted:
    """What structure from motion is asked for; `threads` 0 takes one a core."""

    seed: int
    threads: int
    min_tri_angle_deg: float
    images: int

    @property
    def smallest(self) -> int:
        """Images of a model that is worth keeping."""
        return min(10, max(2, self.images // 2))


def pipeline_options(wanted: Wanted) -> pycolmap.IncrementalPipelineOptions:
    """COLMAP's defaults for a calibrated camera, with fewer global adjustments."""
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = wanted.seed
    options.num_threads = wanted.threads or -1
    options.extract_colors = False
    options.min_model_size = wanted.smallest
    options.max_num_models = 5
    options.ba_refine_focal_length = False
    options.ba_refine_principal_point = False
    options.ba_refine_extra_params = False
    # Constant intrinsics let the global adjustment run more rarely without drift, and nothing needs
    # the last digit on the way: the finished model is adjusted until it stands.
    options.ba_global_frames_ratio = 1.5
    options.ba_global_points_ratio = 1.5
    options.ba_global_max_refinements = 1
    options.ba_global_max_num_iterations = 15
    options.ba_global_function_tolerance = 1e-4
    options.ba_local_max_refinements = 1
    options.ba_local_function_tolerance = 1e-3
    options.mapper.abs_pose_refine_focal_length = False
    options.mapper.abs_pose_refine_extra_params = False
    options.mapper.abs_pose_max_error = 6.0
    options.mapper.filter_min_tri_angle = wanted.min_tri_angle_deg
    options.triangulation.min_angle = wanted.min_tri_angle_deg
    return options


class Incremental:
    """Structure from motion over a database, in a folder that lasts until the map is complete."""

    def __init__(
        self, database: Path, work: Path, wanted: Wanted, on_image: Callable[[], None]
    ) -> None:
        colmap.quiet()
        self._options = pipeline_options(wanted)
        self._mapping = self._options.get_mapper()
        # An image that a weak bridge holds, as behind a turn, comes last, among the most points.
        self._last_demands = self._options.get_mapper()
        self._last_demands.abs_pose_min_num_inliers = self._options.min_num_matches
        self._last_demands.max_reg_trials *= 2
        self._triangulation = self._options.get_triangulation()
        self._seed = wanted.seed
        choice = pycolmap.DatabaseCacheOptions()
        choice.min_num_matches = self._options.min_num_matches
        with pycolmap.Database.open(database) as opened:
            self._cache = pycolmap.DatabaseCache.create(opened, choice)
        self._pipeline = pycolmap.IncrementalPipeline(
            self._options, self._cache, pycolmap.ReconstructionManager()
        )
        self._work = work
        self._snapshots = Snapshots(work / "snapshots")
        self._finished = Snapshots(work / "models")
        self._on_image = on_image

    def run(self, starts: Sequence[colmap.Reconstruction] = ()) -> list[colmap.Reconstruction]:
        """The models, in the order in which they were found; `starts` is where the first begin.

        What the folder holds comes first: finished models, and the newest snapshot of the next.
        """
        models, level = self._already()
        if (self._work / _DONE).exists() and models:
            return models
        while len(models) < self._options.max_num_models:
            placed = {image_id for model in models for image_id in model.reg_image_ids()}
            if models and len(placed) >= self._cache.num_images() - 1:
                break
            start = starts[len(models)] if len(models) < len(starts) else None
            found = self._next_model(models, level, start)
            if found is None:
                break
            model, level = found
            self._finished.save(f"{len(models):02d}", model, level=level)
            self._snapshots.sweep("", kept=0)
            models.append(model)
        (self._work / _DONE).touch()
        return models

    def with_images(
        self, model: colmap.Reconstruction, wTc: Mapping[int, F64]
    ) -> colmap.Reconstruction:
        """The model and further images, by id, at known poses (4, 4); points are made of them."""
        model.load(self._cache)
        for image_id, pose in wTc.items():
            frame = model.frame(model.image(image_id).frame_id)
            frame.rig_from_world = pycolmap.Rigid3d(np.linalg.inv(pose)[:3])
            model.register_frame(frame.frame_id)
        pycolmap.set_random_seed(self._seed)
        mapper = pycolmap.IncrementalMapper(self._cache)
        mapper.begin_reconstruction(model)
        for image_id in wTc:
            mapper.triangulate_image(self._triangulation, image_id)
        self._refine(mapper)
        mapper.end_reconstruction(False)
        return model

    def _already(self) -> tuple[list[colmap.Reconstruction], int]:
        """Finished models up to the first that is not whole, and the level of the last."""
        models: list[colmap.Reconstruction] = []
        level = 0
        for name in self._finished.names():
            found = self._finished.load(name)
            if found is None:
                break
            model, state = found
            models.append(model)
            level = state.get("level", 0)
            self._count(model)
        if len(models) < len(self._finished.names()):
            (self._work / _DONE).unlink(missing_ok=True)
            for name in self._finished.names()[len(models) :]:
                shutil.rmtree(self._work / "models" / name)
        return models, level

    def _count(self, model: colmap.Reconstruction) -> None:
        for _ in range(model.num_reg_images()):
            self._on_image()

    def _mapper(self, models: Sequence[colmap.Reconstruction]) -> pycolmap.IncrementalMapper:
        """A mapper that knows which images are in finished models."""
        mapper = pycolmap.IncrementalMapper(self._cache)
        for model in models:
            mapper.begin_reconstruction(model)
            mapper.end_reconstruction(False)
        return mapper

    def _next_model(
        self,
        models: Sequence[colmap.Reconstruction],
        level: int,
        start: colmap.Reconstruction | None,
    ) -> tuple[colmap.Reconstruction, int] | None:
        """A further model and the level of its first pair; None when no pair gives one."""
        found = self._snapshots.newest(f"{len(models):02d}-")
        batch, more = 0, True
        if found is not None:
            start, state = found
            level, batch, more = state["level"], state["batch"], bool(state["more"])
        if start is not None:
            self._count(start)
        searching, small = self._mapper(models), 0
        while level < _LEVELS and not (models and small >= _GIVEN_UP):
            model = start if start is not None else self._first_pair(searching, level)
            if model is None:
                level += 1
                searching.reset_initialization_stats()
                continue
            model = self._grow(model, models, level, batch, more)
            start, batch, more, small = None, 0, True, small + 1
            if model.num_reg_images() >= self._options.min_model_size or (
                not models and model.num_reg_images() > 1
            ):
                return model, level
            self._snapshots.sweep("", kept=0)
        return None

    def _first_pair(
        self, mapper: pycolmap.IncrementalMapper, level: int
    ) -> colmap.Reconstruction | None:
        """A model of two images; None when no pair is left that meets the demands."""
        demands = copy.copy(self._mapping)
        demands.init_min_num_inliers = self._mapping.init_min_num_inliers >> ((level + 1) // 2)
        demands.init_min_tri_angle = self._mapping.init_min_tri_angle / 2 ** (level // 2)
        demands.num_threads = 1  # of several, the pair whose thread was ready first would win
        status = pycolmap.IncrementalPipelineStatus
        for _ in range(self._options.init_num_trials):
            pycolmap.set_random_seed(self._seed)
            model = pycolmap.Reconstruction()
            mapper.begin_reconstruction(model)
            result = self._pipeline.initialize_reconstruction(mapper, demands, model)
            first = pycolmap.Reconstruction(model)
            mapper.end_reconstruction(True)  # its images count when it has grown
            if result == status.SUCCESS:
                self._count(first)
                return first
            if result == status.NO_INITIAL_PAIR:
                return None
        return None

    def _grow(
        self,
        model: colmap.Reconstruction,
        models: Sequence[colmap.Reconstruction],
        level: int,
        batch: int,
        more: bool,
    ) -> colmap.Reconstruction:
        """All batches that are left; each ends on disk and the next begins there."""
        while more:
            more = self._batch(model, models)
            if model.num_reg_images() < self._options.min_model_size:
                return model
            batch += 1
            name = f"{len(models):02d}-{batch:06d}"
            self._snapshots.save(name, model, level=level, batch=batch, more=int(more))
            self._snapshots.sweep("")
            model = self._snapshots.reread(name)
        return model

    def _batch(self, model: colmap.Reconstruction, models: Sequence[colmap.Reconstruction]) -> bool:
        """Adds images up to the next adjustment of the whole model; whether there may be more."""
        pycolmap.set_random_seed(self._seed)  # a batch does not depend on what ran before it
        mapper = self._mapper(models)
        mapper.begin_reconstruction(model)
        begun = adjusted = model.num_reg_frames()
        points = model.num_points3D()
        added = before = True
        more = False
        while added or before:
            before = added
            image_id = self._register_next(mapper, model)
            added = image_id is not None
            if image_id is not None:
                mapper.triangulate_image(self._triangulation, image_id)
                mapper.iterative_local_refinement(
                    self._options.ba_local_max_refinements,
                    self._options.ba_local_max_refinement_change,
                    self._mapping,
                    self._options.get_local_bundle_adjustment(),
                    self._triangulation,
                    image_id,
                )
                self._on_image()
                if self._pipeline.check_run_global_refinement(model, adjusted, points):
                    self._refine(mapper)
                    adjusted, points = model.num_reg_frames(), model.num_points3D()
                    more = adjusted >= begun + _BATCH
                    if more:
                        break
            if mapper.num_shared_reg_images() >= self._options.max_model_overlap:
                break
            if before and not added:  # once more, now that everything is adjusted
                self._refine(mapper)
                adjusted, points = model.num_reg_frames(), model.num_points3D()
        if not more and model.num_reg_frames() != adjusted:
            self._refine(mapper)
        mapper.end_reconstruction(False)
        return more

    def _register_next(
        self, mapper: pycolmap.IncrementalMapper, model: colmap.Reconstruction
    ) -> int | None:
        """The image that found its place, the best first; None when none does.

        By points; by matches with images where points fail; by as few points as a pair needs
        matches where both fail.
        """
        by_points, by_images = mapper.register_next_image, mapper.register_next_structure_less_image
        for register, demands in (
            (by_points, self._mapping),
            (by_images, self._mapping),
            (by_points, self._last_demands),
        ):
            small = model.num_reg_images() < self._options.min_model_size
            candidates = mapper.find_next_images(demands, register is by_images)
            for trial, image_id in enumerate(candidates):
                if register(demands, image_id):
                    return int(image_id)
                if small and trial >= _STUBBORN:
                    break
        return None

    def _refine(self, mapper: pycolmap.IncrementalMapper) -> None:
        mapper.iterative_global_refinement(
            self._options.ba_global_max_refinements,
            self._options.ba_global_max_refinement_change,
            self._mapping,
            self._options.get_global_bundle_adjustment(),
            self._triangulation,
        )
        mapper.filter_frames(self._mapping)
