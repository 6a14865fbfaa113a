"""Structure from motion of a build, whole or in parts that are made beside each other."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ground_station.arrays import F64, I64
from ground_station.errors import MapError
from ground_station.geometry.alignment import Alignment
from ground_station.geometry.camera import Camera
from ground_station.map import colmap
from ground_station.map.model import Model
from ground_station.mapping.construction import structure
from ground_station.mapping.construction.feature_file import Lazily
from ground_station.mapping.construction.images import Images
from ground_station.mapping.construction.pairs import Pair
from ground_station.mapping.construction.parts import cutting, joining, solving
from ground_station.mapping.construction.parts.solving import Solved
from ground_station.mapping.construction.placing import elsewhere
from ground_station.mapping.construction.placing.chains import components
from ground_station.mapping.construction.placing.placed import IN_PLACE_PX, Placed
from ground_station.mapping.construction.structure import Structure
from ground_station.mapping.construction.workers import Workers
from ground_station.mapping.settings import MappingSettings
from ground_station.mapping.sfm import adjustment
from ground_station.mapping.sfm.two_view import TwoView
from ground_station.progress import Progress

_TOLERANCE = 1e-6
"""Of the adjustment of all parts. In a simulated hall of 150 images in three parts the centres were
off by 2.1 cm after the build's own adjustments, and by 0.8 cm with this; made in one, by 1.0 cm."""
_SAME_DEPTHS = 0.1
"""Two parts' landmarks of one key point are one where they stand so near each other, in distances
to the camera; else one part is mistaken about it."""
_HOLDS = 0.5
"""Share of a pair's landmarks in their place, for which what it matches is one."""


def reconstruct(
    images: Images,
    pairs: dict[Pair, TwoView],
    camera: Camera,
    settings: MappingSettings,
    threads: int,
    work: Path,
    workers: Workers,
    before: Sequence[Mapping[int, F64]] = (),
) -> Structure:
    """As `structure.reconstruct`; of more than `sfm.part_images` images in parts.

    `workers` make the parts, each with one thread. Parts that were finished before a build was
    killed are not made again. Raises `MapError` when no part has a model.
    """
    most = settings.sfm.part_images
    if len(images.names) <= most:
        return structure.reconstruct(images, pairs, camera, settings, threads, work, before)
    matches = {pair: len(view.matches) for pair, view in pairs.items()}
    parts = cutting.overlapping(matches, len(images.names), most)
    folder = work / "parts"
    folder.mkdir(parents=True, exist_ok=True)
    members = cutting.inside(parts, pairs, len(images.names))

    def given(k: int) -> solving.Given:
        return solving.given(parts[k].images, images, {pair: pairs[pair] for pair in members[k]})

    inputs = Lazily(len(parts), given)
    with workers.shared(inputs) as shared, Progress("structure, parts", len(parts)) as progress:

        def calls() -> Iterator[tuple[Any, ...]]:
            for k in range(len(parts)):
                place = str(folder / f"{k:04d}") if workers.here else None
                yield shared[k], camera, settings, 1, place

        found = []
        for solved in workers.map(solving.solve, calls()):
            found.append(solved)
            progress.step()
    return _joined(found, parts, images, pairs, camera, settings, threads)


def _joined(
    found: list[Solved | None],
    parts: list[cutting.Part],
    images: Images,
    pairs: dict[Pair, TwoView],
    camera: Camera,
    settings: MappingSettings,
    threads: int,
) -> Structure:
    """The parts as one model, adjusted as a whole."""
    kept = [(solved, part.core) for solved, part in zip(found, parts, strict=True) if solved]
    if not kept:
        raise MapError(
            f"structure from motion found no model in any of {len(parts)} parts: the camera must "
            "move sideways between images that see the same things"
        )
    solved = [each for each, _ in kept]
    similarities, said = joining.join(solved, settings.seed)
    inside = [
        (part, core, at)
        for (part, core), at in zip(kept, similarities, strict=True)
        if at is not None
    ]
    members, cores, places = (list(column) for column in zip(*inside, strict=True))
    model = unite(members, cores, places, images, pairs, camera)
    apart = [len(part.index) for part, at in zip(solved, similarities, strict=True) if at is None]
    # The parts were adjusted each by itself; the way along which they bend lowers the cost slowly.
    pixels = [images.pinhole_px[k] for k in (model.image_id - 1).tolist()]
    notes = [f"structure from motion in {len(parts)} parts, {len(members)} of them joined"]
    reconstruction = colmap.from_arrays(model, camera, keypoints_px=pixels)
    adjustment.adjust(
        reconstruction, loss_px=settings.sfm.loss_px, threads=threads, tolerance=_TOLERANCE
    )
    placed = Placed.of(colmap.to_arrays(reconstruction), images.pinhole_px)
    for part, core, _ in inside:
        within = f"{images.names[core[0]]} to {images.names[core[-1]]}, {len(core)} images"
        notes += [f"part of {within}: {note}" for note in part.notes.tolist()]
    return Structure(
        reconstruction,
        [len(model.names), *sorted(apart, reverse=True)],
        [],
        notes + said,
        doubts=elsewhere.doubt(elsewhere.rivals(placed, pairs), images.names),
    )


def unite(
    parts: Sequence[Solved],
    cores: Sequence[I64],
    at: Sequence[Alignment],
    images: Images,
    pairs: Mapping[Pair, TwoView],
    camera: Camera,
) -> Model:
    """The model of all parts, each moved by its similarity; images have id = index + 1.

    An image's pose is that of the part whose core it is in, or else of the one that sees most of
    it. Landmarks of several parts become one where they have a key point in common, or where a
    verified pair of images that no part has both of matches them and they stand where it says.
    """
    index, wTc = _poses(parts, cores, at)
    row = np.full(len(images.names), -1, dtype=np.int64)
    row[index] = np.arange(len(index))
    offset = np.cumsum([0, *(len(part.position) for part in parts)])
    position = np.concatenate([by.apply(part.position) for part, by in zip(parts, at, strict=True)])
    image = np.concatenate([part.index[part.image] for part in parts])
    feature = np.concatenate([part.feature for part in parts])
    point = np.concatenate([part.point + first for part, first in zip(parts, offset, strict=False)])
    # Key points by number: the first observation of each decides where it belongs.
    starts = np.cumsum([0, *(len(pixels) for pixels in images.pinhole_px)])
    key = starts[image] + feature
    seen, first, place = np.unique(key, return_index=True, return_inverse=True)
    one, other = point[first][place], point
    apart = np.linalg.norm(position[one] - position[other], axis=1)
    away = np.linalg.norm(position[one] - wTc[row[image], :3, 3], axis=1)
    same = (one != other) & (apart <= _SAME_DEPTHS * away)
    edges = [np.stack([one[same], other[same]], axis=1)]
    holder = np.full(starts[-1], -1, dtype=np.int64)
    holder[seen] = point[first]
    inside = cutting.holders((part.index for part in parts), len(images.names))
    for (i, j), view in pairs.items():
        if row[i] >= 0 and row[j] >= 0 and not inside[i] & inside[j]:
            own = holder[starts[i] : starts[i + 1]], holder[starts[j] : starts[j + 1]]
            px = images.pinhole_px[i], images.pinhole_px[j]
            edges.append(_in_place(own, view, position, wTc[row[[i, j]]], px, parts[0].pinhole))
    landmark = components(edges, len(position))
    sums = np.stack([np.bincount(landmark, position[:, k]) for k in range(3)], axis=1)
    united = sums / np.bincount(landmark)[:, None]
    # Of each key point one observation: the first. A landmark may have lost its others to another
    # one.
    track = landmark[point[first]]
    first = first[np.bincount(track)[track] > 1]
    used, track = np.unique(landmark[point[first]], return_inverse=True)
    image, feature = row[image[first]], feature[first]  # sorted by image
    bounds = np.searchsorted(image, np.arange(1, len(index)))
    pixels = [
        images.pinhole_px[k][mine]
        for k, mine in zip(index.tolist(), np.split(feature, bounds), strict=True)
    ]
    return Model(
        names=[images.names[k] for k in index.tolist()],
        image_id=index + 1,
        wTc=wTc,
        point_id=np.arange(1, len(used) + 1),
        position=united[used],
        image=image,
        feature=feature,
        point=track,
        pixel_px=np.concatenate(pixels),
        camera=camera,
    )


def _poses(
    parts: Sequence[Solved], cores: Sequence[I64], at: Sequence[Alignment]
) -> tuple[I64, F64]:
    """The images (K,) that have a pose, by index, sorted, and their wTc (K, 4, 4)."""
    best: dict[int, tuple[bool, int]] = {}
    wTc: dict[int, F64] = {}
    for part, core, by in zip(parts, cores, at, strict=True):
        observations = np.bincount(part.image, minlength=len(part.index)).tolist()
        own = np.isin(part.index, core).tolist()
        moved = by.apply_poses(part.wTc)
        for n, k in enumerate(part.index.tolist()):
            rank = own[n], observations[n]
            if k not in best or rank > best[k]:
                best[k], wTc[k] = rank, moved[n]
    index = np.array(sorted(wTc), dtype=np.int64)
    return index, np.array([wTc[k] for k in index.tolist()])


def _in_place(
    holder: tuple[I64, I64],
    view: TwoView,
    position: F64,
    wTc: F64,
    pixels: tuple[F64, F64],
    pinhole: F64,
) -> I64:
    """Landmarks (P, 2) that a pair says are one, where each is in the other one's place.

    `holder` gives the landmark of each key point of the two images, -1 for none; `wTc` (2, 4, 4).
    """
    ends = np.stack([of[view.matches[:, k]] for k, of in enumerate(holder)], axis=1)
    known = (ends >= 0).all(axis=1) & (ends[:, 0] != ends[:, 1])
    ends, good = ends[known], np.ones(np.count_nonzero(known), dtype=bool)
    there = Placed([], {}, position, pinhole)
    for one, other in ((0, 1), (1, 0)):
        seen = pixels[other][view.matches[known, other]]
        good &= there.error_px(wTc[other], ends[:, one], seen) <= IN_PLACE_PX
    if good.sum() < _HOLDS * len(good):
        return np.empty((0, 2), np.int64)
    return np.asarray(ends[good])
