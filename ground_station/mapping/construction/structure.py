"""Structure from motion: verified pairs become one model that can be believed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ground_station.arrays import F64
from ground_station.errors import MapError
from ground_station.geometry.camera import Camera
from ground_station.map import colmap, landmarks
from ground_station.map.model import Model
from ground_station.mapping.construction.images import Images
from ground_station.mapping.construction.placing import (
    bridges,
    contradictions,
    elsewhere,
    lookalikes,
    loops,
)
from ground_station.mapping.construction.solver import NEARLY_ALL, Models, Pairs, Solver, covering
from ground_station.mapping.settings import MappingSettings, SfmSettings
from ground_station.mapping.sfm import adjustment
from ground_station.mapping.sfm.models import without_observations, without_points

_FOLDED = 0.1
"""Share of images in the wrong place, or without one although their neighbours have one, from which
on the rest of the model is doubtful, too."""
_TOLERANCES = 1e-4, 1e-5
"""Of the adjustment that finds what does not fit, and of the one without that. Of the red kitchen's
100 images the centres were then as far from where 146 iterations end (a hundred-thousandth of the
room) as with 1e-6, in half the time."""


@dataclass(frozen=True)
class Structure:
    """The largest model, `sizes` of all models in images, and the images dropped.

    `notes`: lines for a person, on models that stay apart and images that changed their place.
    `parts`: the other models, the larger first. `doubts`: sentences on what could not be decided.
    """

    reconstruction: colmap.Reconstruction
    sizes: list[int]
    dropped: list[str]
    notes: list[str] = field(default_factory=list)
    parts: list[colmap.Reconstruction] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)


def reconstruct(
    images: Images,
    pairs: Pairs,
    camera: Camera,
    settings: MappingSettings,
    threads: int,
    work: Path,
    before: Sequence[Mapping[int, F64]] = (),
) -> Structure:
    """COLMAP's model of the images in the places where the chain of neighbours believes them.

    `work` is a folder for its files. What an earlier, killed run of the same inputs left there is
    gone on from. `before`: models by another lens, poses (4, 4) of images by COLMAP's id; the
    search begins there, unless a new one finds more. Raises `MapError` when structure from motion
    finds no model.
    """
    solver = Solver(images, pairs, camera, settings, threads, work)
    links, pairs = solver.links, solver.pairs
    tries = [solver.solve("before", pairs, starts=before)] if before else []
    # What went on from models that were believed are those, and their pairs were chosen already.
    held = len({k for model in tries[0][0] for k in model.reg_image_ids()}) if before else 0
    goes_on = held >= NEARLY_ALL * len(images.names)
    if not goes_on:
        tries.append(solver.solve("all", pairs))
    models, notes = max(
        tries, key=lambda one: sum(model.compute_num_observations() for model in one[0])
    )
    spare: Models = []
    wrong = solver.misplaced(models[0], pairs)
    moved, placed = len(wrong), set(models[0].reg_image_ids())
    missing = {k for link in links for k in link} - {image_id - 1 for image_id in placed}
    doubtful = len(wrong) + len(missing) > _FOLDED * len(images.names)
    asked = links and pairs.keys() - links and not goes_on
    if asked and (doubtful or solver.fall_apart(models, links)):
        spare, trusted = solver.trusted()
        denied = solver.fall_apart(models, trusted.keys())
        if doubtful or denied:
            others, said = solver.solve("trusted", trusted)
            still = solver.misplaced(others[0], trusted)
            if denied or _size(others[0]) - len(still) >= len(placed) - len(wrong):
                models, notes, wrong, pairs = others, said, still, trusted
            else:
                spare += others
    better = {k for k, rival in solver.rivals(models[0], pairs).items() if rival.better} - wrong
    wrong |= better
    moved += len(better)
    if wrong:
        lies = lookalikes.refuted(solver.placed(models[0]), wrong, links, pairs)
        colmap.drop_images(models[0], [k + 1 for k in sorted(wrong)])
        pairs = loops.among(pairs, pairs.keys() - lies)
        models, notes = solver.solve("replaced", pairs, starts=models[:1])
    solver.settle(models[0], pairs)
    models[0], resected = solver.resected(models[0], pairs)
    moved += resected
    models, notes, doubts = _Consistent(solver, pairs, images, camera, settings.sfm).of(
        models, notes, spare, goes_on
    )
    doubts += elsewhere.doubt(solver.rivals(models[0], pairs), images.names)
    doubts += bridges.doubt(bridges.hinges(solver.placed(models[0])), images.names)
    gone = sorted(placed.difference(*(model.reg_image_ids() for model in models)))
    if moved:
        notes.append(
            f"{moved} {'image' if moved == 1 else 'images'} stood where other images see "
            "something else; "
            f"{len(gone)} are left out, the others have other places now"
        )
    return Structure(
        models[0],
        [model.num_reg_images() for model in models],
        [images.names[image_id - 1] for image_id in gone],
        notes,
        models[1:],
        doubts,
    )


class _Consistent:
    """Models without images that the rotations of pairs contradict."""

    def __init__(
        self,
        solver: Solver,
        pairs: Pairs,
        images: Images,
        camera: Camera,
        sfm: SfmSettings,
    ) -> None:
        self._solver, self._pairs, self._sfm = solver, pairs, sfm
        self._wanted = solver.wanted
        self._confirmed = contradictions.rotations(
            pairs, images.pinhole_px, camera.matrix, self._wanted.threads
        )

    def of(
        self, models: Models, notes: list[str], spare: Models, goes_on: bool
    ) -> tuple[Models, list[str], list[str]]:
        """The models where they are consistent, or others that are, with notes and doubts.

        Where they go on from an earlier round's, that round has tried what could hold more.
        Where that breaks the first, or it holds too few images, the others are placed again from
        its largest piece on; then from that of `spare` models of other tries, and of those of the
        global method, which starts nowhere, until one holds nearly all. Else the largest pieces are
        kept, joined again where a similarity does it without a contradiction.
        """
        pieces = self._split(models)
        enough = NEARLY_ALL * len({k for pair in self._pairs for k in pair})
        begun = {*models[0].reg_image_ids()} if pieces[:1] == models[:1] else set()
        if len(begun) >= enough or (goes_on and pieces == models):
            return models, notes, []
        tries: tuple[Callable[[], Models], ...] = (
            lambda: pieces,
            lambda: self._settled(spare),
            lambda: self._settled(self._solver.solve("global", self._pairs, method="global")[0]),
        )
        kept: Models = []
        for number, found_by in enumerate(tries):
            found = found_by()
            kept += found
            largest = max(found, key=_size, default=None)
            if largest is None or begun == {*largest.reg_image_ids()}:
                continue
            if _size(largest) < enough:
                # What is right is a better place to begin at than any pair.
                begun = {*largest.reg_image_ids()}
                again, _ = self._solver.solve(
                    f"again-{number}", self._pairs, starts=[colmap.copied(largest)]
                )
                self._solver.settle(again[0], self._pairs)
                again[0], _ = self._solver.resected(again[0], self._pairs)
                more = self._split(again)
                kept += more
                largest = max([largest, *more], key=_size)
            if _size(largest) >= enough:
                return [largest], [], []
        tried, kept = kept, covering(kept, self._wanted.smallest)
        if not kept:
            raise MapError(
                "structure from motion contradicts what pairs of images say of each other: the "
                "images show too little, or the camera file is of another camera"
            )
        # Of the pairs that were not believed, too: whole pieces know better which are right.
        joined, notes = self._solver.joined(kept, self._solver.pairs)
        doubts: list[str] = []
        if self._split(joined[:1]) != joined[:1]:
            joined, notes = kept, []
            doubts = [
                f"{len(kept)} pieces fit each other only against what pairs of their images say: "
                "they are kept apart"
            ]
        chosen = self._solver.placed(joined[0])
        elsewhere_too = elsewhere.otherwise(
            chosen, (self._solver.placed(one) for one in tried), self._wanted.seed
        )
        return joined, notes, doubts + elsewhere.otherwise_doubt(elsewhere_too, self._solver.names)

    def _settled(self, models: Models) -> Models:
        for model in models:
            self._solver.settle(model, self._pairs)
        return self._split(models)

    def _split(self, models: Models) -> Models:
        """What is consistent of each model: itself, or pieces that are adjusted by themselves."""
        pieces: Models = []
        for model in models:
            placed = self._solver.placed(model)
            groups = contradictions.consistent_groups(placed, self._confirmed, self._pairs)
            sets = [part for group in groups for part in bridges.separated(placed.among(group))]
            if len(sets) == 1:
                pieces.append(model)
                continue
            for part in sets:
                if len(part) < self._wanted.smallest:
                    continue
                # Without the others it is another model, of which pieces may come loose.
                piece = colmap.copied(model)
                others = {*piece.reg_image_ids()} - {k + 1 for k in part}
                colmap.drop_images(piece, sorted(others))
                adjustment.adjust(
                    piece, loss_px=self._sfm.loss_px, threads=self._wanted.threads,
                    tolerance=_TOLERANCES[0],
                )  # fmt: skip
                drop_misfits(piece, self._sfm)
                pieces += self._split([piece])
        return pieces


_FEWEST = 15
"""Observations that an image keeps where it stands: COLMAP asks so many to place one at the last
(`min_num_matches`)."""


def _size(model: colmap.Reconstruction) -> int:
    return int(model.num_reg_images())


def drop_misfits(reconstruction: colmap.Reconstruction, sfm: SfmSettings) -> Model:
    """Takes out observations above `max_error_px`, then points that too few images see.

    A point needs `min_track` images and two observations `min_tri_angle_deg` apart. Returns what is
    left."""
    model = colmap.to_arrays(reconstruction)
    error = np.linalg.norm(landmarks.residuals_px(model), axis=1)
    bad = error > sfm.max_error_px
    colmap.drop_observations(reconstruction, model.image_id[model.image[bad]], model.feature[bad])
    model = without_observations(model, bad)
    # Tracks that were merged may have two key points of one image.
    seen = np.unique(np.stack([model.point, model.image]), axis=1)[0]
    weak = (np.bincount(seen, minlength=len(model.position)) < sfm.min_track) | (
        landmarks.largest_angles_deg(model) < sfm.min_tri_angle_deg
    )
    colmap.drop_points(reconstruction, model.point_id[weak])
    return without_points(model, weak)


def adjust_and_filter(
    reconstruction: colmap.Reconstruction, sfm: SfmSettings, threads: int
) -> Model:
    """Filters and adjusts a model until what is kept fits; raises `MapError` when nothing does.

    Robust bundle adjustment, then observations above `max_error_px` and points below `min_track`
    or `min_tri_angle_deg` go; twice, because the first round's outliers bend the second's poses.
    An image goes when what is left of it would not have placed it.
    """
    for tolerance in _TOLERANCES:
        adjustment.adjust(reconstruction, loss_px=sfm.loss_px, threads=threads, tolerance=tolerance)
        model = drop_misfits(reconstruction, sfm)
    few = np.bincount(model.image, minlength=len(model.names)) < _FEWEST
    if few.any():
        colmap.drop_images(reconstruction, model.image_id[few].tolist())
        model = drop_misfits(reconstruction, sfm)
    if not len(model.point_id):
        raise MapError(
            f"no landmark is seen by {sfm.min_track} images at {sfm.min_tri_angle_deg} degrees: "
            "the camera must move more between images"
        )
    return model
