"""Models of a build's images: solved by COLMAP, joined, and judged by the chain of neighbours."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np

from ground_station.arrays import F64, I64, Bools
from ground_station.errors import MapError
from ground_station.geometry.camera import Camera
from ground_station.map import colmap
from ground_station.mapping.construction.images import Images
from ground_station.mapping.construction.pairs import Pair, sequences
from ground_station.mapping.construction.placing import (
    chains,
    elsewhere,
    lookalikes,
    loops,
    merging,
)
from ground_station.mapping.construction.placing.placed import Placed
from ground_station.mapping.settings import MappingSettings
from ground_station.mapping.sfm import global_mapping
from ground_station.mapping.sfm.database import write_database
from ground_station.mapping.sfm.incremental import Incremental, Wanted
from ground_station.mapping.sfm.two_view import TwoView
from ground_station.progress import Progress

NEARLY_ALL = 0.95
"""Share of the images that a model must have for no other method to be asked."""
_SLACK_DEPTHS = 0.05
"""A step that is always plausible, in depths of the scene: a hovering camera has no usual speed."""
_GAP_STEPS = 20.0
"""A pause so many usual steps long says nothing about where the camera went meanwhile."""

_NO_START = (
    "structure from motion found no pair of images to start from: the camera must move sideways "
    "between images that see the same things"
)

Pairs = Mapping[Pair, TwoView]
Models = list[colmap.Reconstruction]


class Solver:
    """The solved models of one build; each attempt keeps its files in a folder of its own.

    `pairs` are the verified ones, `links` those that are the camera's way. Raises `MapError` where
    the camera did not move in any of them.
    """

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
        if not chains.moved(pairs, images.pinhole_px, camera.matrix, settings.match.error_px):
            raise MapError(_NO_START)
        self.names = images.names
        self._sequence = sequences(images.names, images.time_ns)
        self.wanted = Wanted(
            settings.seed,
            threads,
            settings.sfm.min_tri_angle_deg,
            len(images.names),
        )
        self._ordered = chains.in_order(self._sequence, pairs)
        near = chains.in_front(pairs, images.pinhole_px, camera.matrix, threads)
        counts = [len(pixels) for pixels in images.pinhole_px]
        self.links = chains.links(counts, self._sequence, self._ordered, near)
        self.pairs: Pairs = {
            pair: near[pair] if pair in self.links else view for pair, view in pairs.items()
        }

    def solve(
        self,
        name: str,
        pairs: Pairs,
        *,
        joining: Pairs | None = None,
        starts: Sequence[colmap.Reconstruction | Mapping[int, F64]] = (),
        method: str | None = None,
    ) -> tuple[Models, list[str]]:
        """The models that pairs give, the largest first, and what is to say of the others.

        By the settings' method where none is given. Models are merged by the pairs `joining`, the
        same ones if none are given; the first ones go on from `starts`, models or poses (4, 4) of
        images by COLMAP's id.
        """
        count = len(self._images.names)
        with Progress("structure from motion, images", count) as progress:
            mapping = self._mapping(name, pairs, progress.step)
            models: Models = []
            method = method or self._sfm.method
            if method != "incremental" and not starts:
                folder = self._work / name
                models = global_mapping.reconstruct(
                    folder / "database.db", folder / "global", self.wanted
                )
                most = max((model.num_reg_images() for model in models), default=0)
                if method == "auto" and most < NEARLY_ALL * count:
                    models = []
            models = models or mapping.run(
                [
                    mapping.with_images(colmap.pycolmap.Reconstruction(), start)
                    if isinstance(start, Mapping)
                    else start
                    for start in starts
                ]
            )
        if not models:
            raise MapError(_NO_START)
        return self._joined(mapping, models, pairs if joining is None else joining)

    def trusted(self) -> tuple[Models, Pairs]:
        """Models made of links alone, and the pairs that agree with them."""
        models, _ = self.solve("chain", loops.among(self.pairs, self.links), joining=self.pairs)
        parts = [self.placed(model) for model in models]
        believed = loops.believed(parts, self._sequence, self.links, self.pairs)
        return models, loops.among(self.pairs, believed)

    def joined(self, models: Models, pairs: Pairs) -> tuple[Models, list[str]]:
        """Copies of the models, joined where landmarks say how, and what is to say of them."""
        return self._joined(self._mapping("all", pairs), list(map(colmap.copied, models)), pairs)

    def settle(self, model: colmap.Reconstruction, pairs: Pairs) -> None:
        """Drops images that the chain denies, or that are further off than the camera moves."""
        colmap.drop_images(model, [k + 1 for k in sorted(self.misplaced(model, pairs))])
        seen = colmap.to_arrays(model)
        rays = seen.position[seen.point] - seen.wTc[seen.image, :3, 3]
        depth = float(np.median(np.linalg.norm(rays, axis=1))) if len(rays) else 0.0
        judged = np.flatnonzero(self._ordered[seen.image_id - 1])
        keep = plausible_frames(
            self._images.time_ns[seen.image_id[judged] - 1],
            seen.wTc[judged, :3, 3],
            depth,
            self._sfm.max_jump,
        )
        colmap.drop_images(model, seen.image_id[judged[~keep]])

    def resected(
        self, model: colmap.Reconstruction, pairs: Pairs
    ) -> tuple[colmap.Reconstruction, int]:
        """The model with images where the others put them, and how many of them moved.

        One moves where the model then explains more key points than before, and the chain of
        neighbours allows it.
        """
        moved: set[int] = set()
        while True:
            tried = elsewhere.resected(self.placed(model), pairs, self.wanted.seed)
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

    def placed(self, model: colmap.Reconstruction) -> Placed:
        """The model by index of image and key point."""
        return Placed.of(colmap.to_arrays(model), self._images.pinhole_px)

    def rivals(self, model: colmap.Reconstruction, pairs: Pairs) -> dict[int, elsewhere.Rival]:
        """Images, by index, that fit in another place, too."""
        return elsewhere.rivals(self.placed(model), pairs)

    def misplaced(self, model: colmap.Reconstruction, pairs: Pairs) -> set[int]:
        """Images, by index, that the chain denies."""
        return lookalikes.misplaced(self.placed(model), self.links & pairs.keys(), pairs)

    def fall_apart(self, models: Models, chosen: Collection[Pair]) -> bool:
        """Whether a model is no longer one without the pairs that were not chosen."""
        return any(
            len(lookalikes.pieces(self.placed(model), chosen, self.pairs)) > 1 for model in models
        )

    def _mapping(
        self, name: str, pairs: Pairs, on_image: Callable[[], None] = lambda: None
    ) -> Incremental:
        folder = self._work / name
        folder.mkdir(parents=True, exist_ok=True)
        database = folder / "database.db"
        if not database.exists():
            pixels = self._images.pinhole_px
            write_database(database, self._camera, self._images.names, pixels, pairs)
        return Incremental(database, folder, self.wanted, on_image)

    def _with_moved(
        self, model: colmap.Reconstruction, image: int, wTc: F64, pairs: Pairs
    ) -> colmap.Reconstruction | None:
        """The model with an image, by index, at another pose (4, 4); None where it is no better."""
        other = colmap.copied(model)
        colmap.drop_images(other, [image + 1])
        other = self._mapping("all", pairs).with_images(other, {image + 1: wTc})
        if other.compute_num_observations() <= model.compute_num_observations():
            return None
        worse = self.misplaced(other, pairs) - self.misplaced(model, pairs)
        return None if worse else other

    def _joined(
        self, mapping: Incremental, models: Models, pairs: Pairs
    ) -> tuple[Models, list[str]]:
        """The models, joined where landmarks say how, the largest first, and what is to say.

        The most certain first: what joins two others is then known when a third comes that only
        looks alike.
        """
        notes: list[str] = []
        places: dict[int, Placed] = {}  # of a model, by its identity
        found: dict[tuple[int, int], merging.Junction] = {}
        while True:
            models = covering(models, fewest=1)
            places = {id(one): places.get(id(one)) or self.placed(one) for one in models}
            for ids in combinations(places, 2):
                if ids not in found:
                    here, there = (places[each] for each in ids)
                    found[ids] = merging.junction(here, there, pairs, self.wanted.seed)
            best = max(
                combinations(models, 2),
                key=lambda two: found[id(two[0]), id(two[1])].landmarks,
                default=None,
            )
            if best is None:
                break
            target, source = best
            junction = found[id(target), id(source)]
            if junction.similarity is None:
                break
            here, there = places.pop(id(target)), places.pop(id(source))
            new = merging.poses_in(there, junction.similarity, set(here.wTc))
            mapping.with_images(target, new)
            notes.append(f"a model of {len(there.wTc)} images joined to one of {len(here.wTc)}")
            models = [model for model in models if model is not source]
            found = {two: one for two, one in found.items() if id(target) not in two}
        for other in models[1:]:
            # Of pairs that are not believed, too: they may say two things.
            two = places[id(models[0])], places[id(other)]
            why = merging.junction(*two, self.pairs, self.wanted.seed).missing
            why = why or found[id(models[0]), id(other)].missing
            notes.append(merging.describe(other, self._images.names, why))
        return models, notes


def covering(models: Models, fewest: int) -> Models:
    """The models that have all images, in turn the one that adds the most; `fewest` or more."""
    kept: Models = []
    placed: set[int] = set()

    def new(model: colmap.Reconstruction) -> int:
        return len({*model.reg_image_ids()} - placed)

    while models:
        model = max(models, key=new)
        if kept and new(model) < fewest:
            break
        kept.append(model)
        placed |= {*model.reg_image_ids()}
        models = [other for other in models if other is not model]
    return kept


def plausible_frames(time_ns: I64, position: F64, depth: float, max_jump: float) -> Bools:
    """Which frames belong to the largest set in which every step is plausible, (K,).

    `time_ns` (K,) in the order of the input, `position` (K, 3) and `depth`, the median distance of
    what the frames see, in the same units. A step between frames is plausible when it is at most
    `max_jump` times as fast as nine in ten of all steps. Where time falls back or pauses
    for long (another input), a new sequence starts, which is judged by itself.
    """
    keep = np.ones(len(time_ns), dtype=bool)
    dt = np.diff(time_ns) / 1e9
    if not (dt > 0).any():
        return keep
    usual_s = float(np.median(dt[dt > 0]))
    breaks = np.flatnonzero((dt <= 0) | (dt > _GAP_STEPS * usual_s)) + 1
    steps = np.linalg.norm(np.diff(position, axis=0), axis=1)
    inside = (dt > 0) & (dt <= _GAP_STEPS * usual_s)
    if not inside.any():
        return keep
    speed = max_jump * float(np.percentile(steps[inside] / dt[inside], 90))
    for part in np.split(np.arange(len(time_ns)), breaks):
        keep[part] = _longest_chain(
            time_ns[part] / 1e9, position[part], speed, _SLACK_DEPTHS * depth
        )
    return keep


def _longest_chain(time_s: F64, position: F64, speed: float, slack: float) -> Bools:
    """The most frames, in order, with every step at most speed · Δt + slack; by dynamic program."""
    n = len(time_s)
    length, before = np.ones(n, dtype=int), np.full(n, -1)
    for i in range(1, n):
        reach = speed * (time_s[i] - time_s[:i]) + slack
        possible = np.linalg.norm(position[:i] - position[i], axis=1) <= reach
        if possible.any():
            # Of equally long chains the one with the nearest predecessor.
            j = i - 1 - int(np.argmax(np.where(possible, length[:i], 0)[::-1]))
            length[i], before[i] = length[j] + 1, j
    keep = np.zeros(n, dtype=bool)
    i = int(np.argmax(length))
    while i >= 0:
        keep[i] = True
        i = int(before[i])
    return keep
