"""Structure from motion of a build, whole or in parts that are made beside each other."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ground_station.arrays import F64
from ground_station.errors import MapError
from ground_station.geometry.camera import Camera
from ground_station.map import colmap
from ground_station.mapping.construction import structure
from ground_station.mapping.construction.feature_file import Lazily
from ground_station.mapping.construction.images import Images
from ground_station.mapping.construction.pairs import Pair
from ground_station.mapping.construction.parts import cutting, joining, solving, uniting
from ground_station.mapping.construction.placing import elsewhere
from ground_station.mapping.construction.placing.placed import Placed
from ground_station.mapping.construction.structure import Structure
from ground_station.mapping.construction.workers import Workers
from ground_station.mapping.settings import MappingSettings
from ground_station.mapping.sfm import adjustment
from ground_station.mapping.sfm.two_view import TwoView
from ground_station.progress import Progress

_TOLERANCE = 1e-6
"""Of the adjustment of all parts. In a simulated hall of 150 images in three parts the centres were
off by 2.1 cm after the build's own adjustments, and by 0.8 cm with this; made in one, by 1.0 cm."""


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
    found: list[solving.Solved | None],
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
    joined = joining.join(solved, settings.seed)
    inside = [
        (part, core, at)
        for (part, core), at in zip(kept, joined.similarities, strict=True)
        if at is not None
    ]
    members, cores, places = (list(column) for column in zip(*inside, strict=True))
    model = uniting.unite(members, cores, places, images, pairs, camera)
    apart = [
        len(part.index) for part, at in zip(solved, joined.similarities, strict=True) if at is None
    ]
    # The parts were adjusted each by itself; the way along which they bend lowers the cost slowly.
    pixels = [images.pinhole_px[k] for k in (model.image_id - 1).tolist()]
    notes = [f"structure from motion in {len(parts)} parts, {len(members)} of them joined"]
    reconstruction = colmap.from_arrays(model, camera, keypoints_px=pixels)
    adjustment.adjust(
        reconstruction, loss_px=settings.sfm.loss_px, threads=threads, tolerance=_TOLERANCE
    )
    for part, core, _ in inside:
        within = f"{images.names[core[0]]} to {images.names[core[-1]]}, {len(core)} images"
        notes += [f"part of {within}: {note}" for note in part.notes.tolist()]
    return Structure(
        reconstruction,
        [len(model.names), *sorted(apart, reverse=True)],
        [],
        notes + joined.notes,
        doubts=elsewhere.doubt(
            elsewhere.rivals(
                Placed.of(colmap.to_arrays(reconstruction), [len(p) for p in images.pinhole_px]),
                pairs, images.pinhole_px, camera.matrix,
            ),
            images.names,
        ),
    )  # fmt: skip
