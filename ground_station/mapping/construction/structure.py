"""Structure from motion: verified pairs become one model that can be believed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ground_station.arrays import F64
from ground_station.errors import MapError
from ground_station.geometry.camera import Camera
from ground_station.map import colmap, landmarks
from ground_station.map.model import Model
from ground_station.mapping.construction.consistency import plausible_frames
from ground_station.mapping.construction.images import Images
from ground_station.mapping.construction.pairs import Pair, sequences
from ground_station.mapping.construction.placing import (
    bridges,
    chains,
    contradictions,
    elsewhere,
    lookalikes,
    loops,
    merging,
    resection,
)
from ground_station.mapping.construction.placing.placed import Placed
from ground_station.mapping.settings import MappingSettings, SfmSettings
from ground_station.mapping.sfm import adjustment, global_mapping
from ground_station.mapping.sfm.database import write_database
from ground_station.mapping.sfm.incremental import Incremental, Wanted
from ground_station.mapping.sfm.models import without_observations, without_points
from ground_station.mapping.sfm.two_view import TwoView
from ground_station.progress import Progress

_FOLDED = 0.1
"""Share of images in the wrong place, or without one although their neighbours have one, from which
on the rest of the model is doubtful, too."""
_TOLERANCES = 1e-4, 1e-5
"""Of the adjustment that finds what does not fit, and of the one without that. Of the red kitchen's
100 images the centres were then as far from where 146 iterations end (a hundred-thousandth of the
room) as with 1e-6, in half the time."""
_NEARLY_ALL = 0.95
"""Share of the images that a model must have for no other method to be asked."""


Pairs = Mapping[Pair, TwoView]


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
) -> Structure:
    """COLMAP's model of the images in the places where the chain of neighbours believes them.

    `work` is a folder for its files. What an earlier, killed run of the same inputs left there is
    gone on from. Raises `MapError` when structure from motion finds no model.
    """
    return _Reconstruction(images, pairs, camera, settings, threads, work).run()


class _Reconstruction:
    """The steps of one build; each keeps its files in a folder of its own."""

    def __init__(
        self,
        images: Images,
        pairs: Pairs,
        camera: Camera,
        settings: MappingSettings,
        threads: int,
        work: Path,
    ) -> None:
        self._images, self._camera, self._sfm, self._work = images, camera, settings.sfm, work
        self._counts = [len(pixels) for pixels in images.pinhole_px]
        self._sequence = sequences(images.names, images.time_ns)
        self._wanted = Wanted(
            settings.seed,
            threads,
            settings.sfm.min_tri_angle_deg,
            len(images.names),
        )
        self._ordered = chains.in_order(self._sequence, pairs)
        near = chains.in_front(pairs, images.pinhole_px, camera.matrix, threads)
        self._links = chains.links(self._counts, self._sequence, self._ordered, near)
        self._pairs: Pairs = {
            pair: near[pair] if pair in self._links else view for pair, view in pairs.items()
        }

    def run(self) -> Structure:
        """Models, their judgement, and another try where the chain contradicts them."""
        links, pairs = self._links, self._pairs
        models, notes = self._solve("all", pairs)
        spare: list[colmap.Reconstruction] = []
        wrong = self._misplaced(models[0], pairs)
        moved, placed = len(wrong), set(models[0].reg_image_ids())
        missing = {k for link in links for k in link} - {image_id - 1 for image_id in placed}
        doubtful = len(wrong) + len(missing) > _FOLDED * len(self._counts)
        if doubtful and links and pairs.keys() - links:
            spare, trusted = self._trusted(pairs)
            others, said = self._solve("trusted", trusted)
            still = self._misplaced(others[0], trusted)
            if others[0].num_reg_images() - len(still) >= len(placed) - len(wrong):
                models, notes, wrong, pairs = others, said, still, trusted
            else:
                spare += others
        better = {k for k, rival in self._rivals(models[0], pairs).items() if rival.better} - wrong
        wrong |= better
        moved += len(better)
        if wrong:
            model = self._placed(models[0])
            lies = lookalikes.refuted(model, wrong, links, pairs, self._images.pinhole_px)
            colmap.drop_images(models[0], [k + 1 for k in sorted(wrong)])
            pairs = loops.among(pairs, pairs.keys() - lies)
            models, notes = self._solve("replaced", pairs, start=models[0])
            self._drop_misplaced(models[0], pairs)
        self._drop_implausible(models[0])
        models[0], resected = self._resected(models[0], pairs)
        moved += resected
        models, notes, doubts = self._consistent(models, notes, spare, pairs)
        doubts += elsewhere.doubt(self._rivals(models[0], pairs), self._images.names)
        doubts += bridges.doubt(bridges.hinges(self._placed(models[0])), self._images.names)
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
            [self._images.names[image_id - 1] for image_id in gone],
            notes,
            models[1:],
            doubts,
        )

    def _resected(
        self, model: colmap.Reconstruction, pairs: Pairs
    ) -> tuple[colmap.Reconstruction, int]:
        """The model with images where the others put them, and how many of them moved.

        One moves where the model then explains more key points than before, and the chain of
        neighbours allows it.
        """
        moved: set[int] = set()
        while True:
            tried = self._elsewhere(model, pairs)
            better = next(
                (
                    (k, other)
                    for k, wTc in tried.items()
                    if k not in moved and (other := self._with_moved(model, k, wTc, pairs))
                ),
                None,
            )
            if better is None:
                return model, len(moved)
            moved.add(better[0])
            model = better[1]

    def _elsewhere(self, model: colmap.Reconstruction, pairs: Pairs) -> dict[int, F64]:
        placed, pixels = self._placed(model), self._images.pinhole_px
        return resection.elsewhere(placed, pairs, pixels, self._wanted.seed)

    def _with_moved(
        self, model: colmap.Reconstruction, image: int, wTc: F64, pairs: Pairs
    ) -> colmap.Reconstruction | None:
        """The model with an image, by index, at another pose (4, 4); None where it is no better."""
        other = colmap.copied(model)
        colmap.drop_images(other, [image + 1])
        work = self._work / "all"
        mapping = Incremental(work / "database.db", work, self._wanted, lambda: None)
        other = mapping.with_images(other, {image + 1: wTc})
        if other.compute_num_observations() <= model.compute_num_observations():
            return None
        worse = self._misplaced(other, pairs) - self._misplaced(model, pairs)
        return None if worse else other

    def _consistent(
        self,
        models: list[colmap.Reconstruction],
        notes: list[str],
        spare: list[colmap.Reconstruction],
        pairs: Pairs,
    ) -> tuple[list[colmap.Reconstruction], list[str], list[str]]:
        """Models without images that the rotations of pairs contradict, with notes and doubts.

        Where that breaks the first, or it holds too few images, the others are placed again from
        its largest piece on; then from that of `spare` models of other tries, and of those of the
        global method, which starts nowhere, until one holds nearly all. Else the largest pieces are
        kept, joined again where a similarity does it without a contradiction.
        """
        confirmed = contradictions.rotations(
            pairs, self._images.pinhole_px, self._camera.matrix, self._wanted.threads
        )

        def split(model: colmap.Reconstruction) -> list[colmap.Reconstruction]:
            placed = self._placed(model)
            groups = contradictions.consistent_groups(
                placed, confirmed, pairs, self._images.pinhole_px
            )
            sets = [part for group in groups for part in bridges.separated(placed.among(group))]
            if len(sets) == 1:
                return [model]
            pieces = []
            for part in sets:
                if len(part) < self._wanted.smallest:
                    continue
                # Without the others it is another model, of which pieces may come loose.
                piece = self._kept(model, part)
                adjustment.adjust(
                    piece, loss_px=self._sfm.loss_px, threads=self._wanted.threads,
                    tolerance=_TOLERANCES[0],
                )  # fmt: skip
                drop_misfits(piece, self._sfm)
                pieces += split(piece)
            return pieces

        pieces = [piece for model in models for piece in split(model)]
        linked = {k for pair in pairs for k in pair}
        enough = _NEARLY_ALL * len(linked)
        begun = {*models[0].reg_image_ids()} if pieces[:1] == models[:1] else set()
        if len(begun) >= enough:
            return models, notes, []
        tries: tuple[Callable[[], list[colmap.Reconstruction]], ...] = (
            lambda: [],
            lambda: spare,
            lambda: self._solve("global", pairs, method="global")[0],
        )
        for number, models_of in enumerate(tries):
            found = [] if number else pieces
            for model in models_of():
                self._drop_misplaced(model, pairs)
                self._drop_implausible(model)
                found += split(model)
            pieces += found if number else []
            largest = max(found, key=_size, default=None)
            if largest is None or begun == {*largest.reg_image_ids()}:
                continue
            if _size(largest) < enough:
                # What is right is a better place to begin at than any pair.
                begun = {*largest.reg_image_ids()}
                again, _ = self._solve(f"again-{number}", pairs, start=colmap.copied(largest))
                self._drop_misplaced(again[0], pairs)
                self._drop_implausible(again[0])
                again[0], _ = self._resected(again[0], pairs)
                more = [piece for model in again for piece in split(model)]
                pieces += more
                largest = max([largest, *more], key=_size)
            if _size(largest) >= enough:
                return [largest], [], []
        pieces = self._covering(pieces)
        if not pieces:
            raise MapError(
                "structure from motion contradicts what pairs of images say of each other: the "
                "images show too little, or the camera file is of another camera"
            )
        work = self._work / "all"
        mapping = Incremental(work / "database.db", work, self._wanted, lambda: None)
        joined, notes = self._merged(mapping, [colmap.copied(each) for each in pieces], pairs)
        if split(joined[0]) == joined[:1]:
            return joined, notes, []
        return pieces, [], [
            f"{len(pieces)} pieces fit each other only against what pairs of their images say: "
            "they are kept apart"
        ]  # fmt: skip

    def _covering(self, pieces: list[colmap.Reconstruction]) -> list[colmap.Reconstruction]:
        """The pieces that have all images, in turn the one that adds the most."""
        kept: list[colmap.Reconstruction] = []
        placed: set[int] = set()

        def new(piece: colmap.Reconstruction) -> int:
            return len({*piece.reg_image_ids()} - placed)

        while pieces:
            piece = max(pieces, key=new)
            if kept and new(piece) < self._wanted.smallest:
                break
            kept.append(piece)
            placed |= {*piece.reg_image_ids()}
            pieces = [other for other in pieces if other is not piece]
        return kept

    @staticmethod
    def _kept(model: colmap.Reconstruction, group: set[int]) -> colmap.Reconstruction:
        """A copy of a model with these images, by index, only."""
        copy = colmap.copied(model)
        colmap.drop_images(copy, sorted({*copy.reg_image_ids()} - {k + 1 for k in group}))
        return copy

    def _trusted(self, pairs: Pairs) -> tuple[list[colmap.Reconstruction], Pairs]:
        """Models made of links alone, and the pairs that agree with them."""
        models, _ = self._solve("chain", loops.among(pairs, self._links), joining=pairs)
        parts = [self._placed(model) for model in models]
        believed = loops.believed(parts, self._sequence, self._links, pairs)
        return models, loops.among(pairs, believed)

    def _solve(
        self,
        name: str,
        pairs: Pairs,
        *,
        joining: Pairs | None = None,
        start: colmap.Reconstruction | None = None,
        method: str | None = None,
    ) -> tuple[list[colmap.Reconstruction], list[str]]:
        """The models that pairs give, the largest first, and what is to say of the others.

        By the settings' method where none is given.

        Models are merged by the pairs `joining`, the same ones if none are given; the first one
        goes on from `start`.
        """
        folder = self._work / name
        folder.mkdir(parents=True, exist_ok=True)
        database = folder / "database.db"
        if not database.exists():
            pixels = self._images.pinhole_px
            write_database(database, self._camera, self._images.names, pixels, pairs)
        count = len(self._images.names)
        with Progress("structure from motion, images", count) as progress:
            mapping = Incremental(database, folder, self._wanted, progress.step)
            models: list[colmap.Reconstruction] = []
            method = method or self._sfm.method
            if method != "incremental" and start is None:
                models = global_mapping.reconstruct(database, folder / "global", self._wanted)
                most = max((model.num_reg_images() for model in models), default=0)
                if method == "auto" and most < _NEARLY_ALL * count:
                    models = []
            models = models or mapping.run(start)
        if not models:
            raise MapError(
                "structure from motion found no pair of images to start from: the camera must move "
                "sideways between images that see the same things"
            )
        return self._merged(mapping, models, pairs if joining is None else joining)

    def _merged(
        self, mapping: Incremental, models: list[colmap.Reconstruction], pairs: Pairs
    ) -> tuple[list[colmap.Reconstruction], list[str]]:
        largest, *others = sorted(models, key=lambda model: -model.num_reg_images())
        notes: list[str] = []
        missing: list[str] = []
        joined = True
        while joined and others:
            joined = False
            waiting, others, missing = others, [], []
            for other in waiting:
                source, target = self._placed(other), self._placed(largest)
                if source.wTc.keys() <= target.wTc.keys():
                    continue
                junction = merging.junction(target, source, pairs, self._wanted.seed)
                if junction.similarity is None:
                    others.append(other)
                    missing.append(merging.describe(other, self._images.names, junction.missing))
                    continue
                new = merging.poses_in(source, junction.similarity, set(target.wTc))
                largest = mapping.with_images(largest, new)
                notes.append(f"a model of {len(source.wTc)} images joined to the largest")
                joined = True
        return [largest, *others], notes + missing

    def _placed(self, model: colmap.Reconstruction) -> Placed:
        return Placed.of(colmap.to_arrays(model), self._counts)

    def _rivals(self, model: colmap.Reconstruction, pairs: Pairs) -> dict[int, elsewhere.Rival]:
        return elsewhere.rivals(
            self._placed(model), pairs, self._images.pinhole_px, self._camera.matrix
        )

    def _misplaced(self, model: colmap.Reconstruction, pairs: Pairs) -> set[int]:
        links = self._links & pairs.keys()
        return lookalikes.misplaced(self._placed(model), links, pairs, self._images.pinhole_px)

    def _drop_misplaced(self, model: colmap.Reconstruction, pairs: Pairs) -> None:
        colmap.drop_images(model, [k + 1 for k in sorted(self._misplaced(model, pairs))])

    def _drop_implausible(self, reconstruction: colmap.Reconstruction) -> None:
        """Drops images that are further off than the camera moves; of those in order only."""
        model = colmap.to_arrays(reconstruction)
        rays = model.position[model.point] - model.wTc[model.image, :3, 3]
        depth = float(np.median(np.linalg.norm(rays, axis=1))) if len(rays) else 0.0
        judged = np.flatnonzero(self._ordered[model.image_id - 1])
        keep = plausible_frames(
            self._images.time_ns[model.image_id[judged] - 1],
            model.wTc[judged, :3, 3],
            depth,
            self._sfm.max_jump,
        )
        colmap.drop_images(reconstruction, model.image_id[judged[~keep]])


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
    """
    for tolerance in _TOLERANCES:
        adjustment.adjust(reconstruction, loss_px=sfm.loss_px, threads=threads, tolerance=tolerance)
        model = drop_misfits(reconstruction, sfm)
    if not len(model.point_id):
        raise MapError(
            f"no landmark is seen by {sfm.min_track} images at {sfm.min_tri_angle_deg} degrees: "
            "the camera must move more between images"
        )
    return model
