"""The images' pairs that share a geometry: matched both ways and verified."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import Any

import numpy as np

from ground_station.arrays import F32, F64, I32, I64, U16
from ground_station.errors import MapError
from ground_station.geometry.camera import Camera
from ground_station.mapping.construction import content
from ground_station.mapping.construction import pairs as choice
from ground_station.mapping.construction.cache import Cache, Known
from ground_station.mapping.construction.feature_file import KeptFeatures, KeptSide, Lazily, Side
from ground_station.mapping.construction.images import Images
from ground_station.mapping.construction.matching import mutual_matches, verify
from ground_station.mapping.construction.pairs import Pair
from ground_station.mapping.construction.workers import Workers
from ground_station.mapping.settings import MappingSettings, MatchSettings
from ground_station.mapping.sfm.two_view import TwoView
from ground_station.progress import Progress

_RULES = (
    "ratio", "error_px", "planar_ratio", "min_inliers", "min_inlier_ratio", "preview",
    "preview_matches",
)  # fmt: skip
"""Settings that decide what is found of a pair, and so are a part of its key in a cache."""


def rules_of(settings: MappingSettings, far: bool) -> MatchSettings:
    """The settings' rules for neighbours in time, or for images far apart, of their features."""
    # Lowe's 0.8 is for SIFT. Of ALIKE's matches in the sample's mapping flight it leaves a third:
    # 47 verified pairs of 32 pictures, where 0.95 leaves 111.
    wanted = settings.match.of(settings.features)
    if far:
        return replace(wanted, min_inliers=wanted.min_inliers_far)
    return replace(wanted, min_inlier_ratio=0.0, preview=0, preview_matches=0)


def key_of(rules: MatchSettings, camera: Camera) -> bytes:
    """What, besides their features, decides the geometry of a pair that is compared by rules."""
    return content.comparison(camera, {name: getattr(rules, name) for name in _RULES})


def match(
    images: Images,
    camera: Camera,
    settings: MappingSettings,
    workers: Workers,
    *,
    cache: Cache | None = None,
    matched: dict[Pair, U16] | None = None,
) -> dict[Pair, TwoView]:
    """Verified pairs (i, j) of images; raises `MapError` when no two images overlap.

    What `cache` holds is not compared again. Where not every pair is compared, a second round
    tries those that images seen by both bring near each other. `matched` are what `alike` found of
    pairs, by whatever lens: nine tenths of a comparison. What is new is added to it.
    """
    descriptors = Lazily(len(images.names), lambda k: images.features[k].descriptors)
    sequence = choice.sequences(images.names, images.time_ns)
    wanted = settings.match.of(settings.features)
    chosen = choice.choose_pairs(descriptors, wanted, settings.seed, sequence)
    kept = images.features
    if isinstance(kept, KeptFeatures) and workers.here:
        sharing: AbstractContextManager[Sequence[Any]] = nullcontext(kept.sides(images.pinhole_px))
    else:
        sharing = workers.shared(
            Lazily(len(descriptors), lambda k: (descriptors[k], images.pinhole_px[k]))
        )
    with sharing as shared:
        run = _Comparison(
            images, shared, camera, settings, sequence, cache, workers,
            {} if matched is None else matched,
        )  # fmt: skip
        verified = run.compare(chosen, "matching, pairs")
        if wanted.covisible and not choice.is_exhaustive(len(descriptors), wanted):
            linked = {pair: len(view.matches) for pair, view in verified.items()}
            more = choice.covisible_pairs(len(descriptors), chosen, linked, wanted)
            verified |= run.compare(more, "matching, pairs seen together")
    if cache:
        cache.flush()
    if not verified:
        raise MapError(
            f"no two of the {len(images.names)} images overlap: "
            f"no pair has {settings.match.min_inliers} verified matches"
        )
    return dict(sorted(verified.items()))


def alike(first: F32, second: F32, rules: MatchSettings) -> I32:
    """Matches (K, 2) of two images' descriptors by the rules; none where they are too few."""
    # Most pairs far apart share nothing, and a few of the strongest features tell: Wu,
    # "Towards linear-time incremental structure from motion", 3DV 2013, section 3.
    few, others = first[: rules.preview], second[: rules.preview]
    if rules.preview and len(mutual_matches(few, others, rules.ratio)) < rules.preview_matches:
        return np.empty((0, 2), np.int32)
    matches = mutual_matches(first, second, rules.ratio)
    return matches if len(matches) >= rules.min_inliers else matches[:0]


def verify_pairs(
    pairs: Sequence[tuple[int, int, MatchSettings, U16 | None]],
    camera_matrix: F64,
    *sides: Side | KeptSide,
) -> list[tuple[U16, TwoView | None]]:
    """Of each (i, j, rules, matches), i and j indices into `sides`: the matches (K, 2), by `alike`
    where they are not known, and the geometry that they share.
    """
    opened = [side.load() if isinstance(side, KeptSide) else side for side in sides]
    result = []
    for i, j, rules, known in pairs:
        (first, first_px), (second, second_px) = opened[i], opened[j]
        matches = alike(first, second, rules) if known is None else known.astype(np.int32)
        view = verify(first_px, second_px, matches, camera_matrix, rules)
        result.append((matches.astype(np.uint16), view))
    return result


class _Comparison:
    """Compares pairs of one build's images: what the cache knows, and the workers for the rest."""

    def __init__(
        self,
        images: Images,
        sides: Sequence[Any],
        camera: Camera,
        settings: MappingSettings,
        sequence: I64,
        cache: Cache | None,
        workers: Workers,
        matched: dict[Pair, U16],
    ) -> None:
        self._images, self._sides, self._sequence = images, sides, sequence
        self._matrix = camera.matrix
        self._neighbours = settings.match.neighbours
        self._rules = {far: rules_of(settings, far) for far in (False, True)}
        self._how = {far: key_of(rules, camera) for far, rules in self._rules.items()}
        self._cache, self._workers, self._matched = cache, workers, matched

    def compare(self, pairs: Sequence[Pair], label: str) -> dict[Pair, TwoView]:
        """The pairs that share a geometry."""
        verified: dict[Pair, TwoView] = {}
        under_way: deque[list[Pair]] = deque()
        with Progress(label, len(pairs)) as progress:

            def note(pair: Pair, view: TwoView | None, *, new: bool) -> None:
                if new and self._cache:
                    self._cache.keep_view(self._key(pair), view)
                if view is not None:
                    verified[pair] = view
                progress.step()

            def missing() -> Iterator[list[Pair]]:
                batch: list[Pair] = []
                for pair in pairs:
                    known = self._known(pair)
                    matches = self._matched.get(pair)
                    if known is not None or (matches is not None and not len(matches)):
                        note(pair, known.view if known else None, new=known is None)
                        continue
                    batch.append(pair)
                    if len(batch) == self._workers.batch:
                        yield batch
                        batch = []
                if batch:
                    yield batch

            def calls() -> Iterator[tuple[Any, ...]]:
                for batch in missing():
                    under_way.append(batch)
                    yield self._call(batch)

            for views in self._workers.map(verify_pairs, calls()):
                for pair, (matches, view) in zip(under_way.popleft(), views, strict=True):
                    self._matched[pair] = matches
                    note(pair, view, new=True)
        return verified

    def _is_far(self, pair: Pair) -> bool:
        i, j = pair
        return j - i > self._neighbours or bool(self._sequence[i] != self._sequence[j])

    def _key(self, pair: Pair) -> bytes:
        i, j = pair
        keys = self._images.keys
        return content.pair_key(keys[i], keys[j], self._how[self._is_far(pair)])

    def _known(self, pair: Pair) -> Known | None:
        if not self._cache:
            return None
        i, j = pair
        counts = len(self._images.features[i]), len(self._images.features[j])
        return self._cache.view(self._key(pair), counts)

    def _call(self, batch: Sequence[Pair]) -> tuple[Any, ...]:
        """The arguments of `verify_pairs`, with each image once."""
        used = sorted({k for pair in batch for k in pair})
        place = {k: n for n, k in enumerate(used)}
        rows = [
            (place[i], place[j], self._rules[self._is_far((i, j))], self._matched.get((i, j)))
            for i, j in batch
        ]
        return rows, self._matrix, *(self._sides[k] for k in used)
