"""One part's structure from motion, in a process that may know nothing but this part."""

from __future__ import annotations

import shutil
import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ground_station import progress
from ground_station.arrays import F64, I64
from ground_station.errors import MapError
from ground_station.geometry.camera import Camera
from ground_station.map import colmap
from ground_station.mapping.construction.images import Images
from ground_station.mapping.construction.pairs import Pair
from ground_station.mapping.construction.structure import reconstruct
from ground_station.mapping.settings import MappingSettings
from ground_station.mapping.sfm.two_view import TwoView
from pi_firmware.wire import files


@dataclass(frozen=True)
class Given:
    """What is known of a part: the `index` (K,) of its images in the build, they, and their pairs.

    The images are without features, in the order of `index`; pairs (i, j) are of places in it.
    """

    index: I64
    images: Images
    pairs: dict[Pair, TwoView]


@dataclass(frozen=True)
class Solved:
    """A part's largest model, in coordinates of its own.

    `index` (K,) of its images in the build and their `wTc` (K, 4, 4); `position` (M, 3);
    observation o is key point `feature[o]` of image `image[o]`, a place in `index`, and of point
    `point[o]`. `pinhole` is fx, fy, cx, cy; `notes` are texts, what structure from motion has to
    say."""

    index: I64
    wTc: F64
    position: F64
    image: I64
    feature: I64
    point: I64
    pinhole: F64
    notes: npt.NDArray[np.str_]


def given(part: I64, images: Images, pairs: Mapping[Pair, TwoView]) -> Given:
    """What a part's images (K,) are known by, and pairs of them."""
    place = {k: n for n, k in enumerate(part.tolist())}
    names, pixels = [images.names[k] for k in place], [images.pinhole_px[k] for k in place]
    within = {(place[i], place[j]): view for (i, j), view in pairs.items()}
    return Given(part, Images(names, images.time_ns[part], [], pixels), within)


def solve(
    part: Given, camera: Camera, settings: MappingSettings, threads: int, work: str | None
) -> Solved | None:
    """The model of a part; None where no two of its images give one.

    `work` is a folder that outlives a killed build, which goes on from what it finds there; without
    one nothing is kept.
    """
    if work is None:
        with tempfile.TemporaryDirectory(prefix="blimp-part-") as passing:
            return _solved(part, camera, settings, threads, Path(passing))
    folder = Path(work)
    done = folder.with_suffix(".npz")
    found = _read(done)
    if found is None:
        found = _solved(part, camera, settings, threads, folder)
        if found is not None:
            _write(done, found)
        shutil.rmtree(folder, ignore_errors=True)
    return found


def _solved(
    part: Given, camera: Camera, settings: MappingSettings, threads: int, folder: Path
) -> Solved | None:
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with progress.silent():  # the build counts parts
            structure = reconstruct(part.images, part.pairs, camera, settings, threads, folder)
    except MapError:  # images that only turn, or show one plane: no part of a map
        return None
    model = colmap.to_arrays(structure.reconstruction)
    return Solved(
        part.index[model.image_id - 1],
        model.wTc,
        model.position,
        model.image,
        model.feature,
        model.point,
        model.pinhole,
        np.array(structure.notes, dtype=np.str_),
    )


def _write(path: Path, solved: Solved) -> None:
    with files.replacing(path) as part, part.open("wb") as file:
        np.savez(file, **vars(solved))


def _read(path: Path) -> Solved | None:
    """What was written there; None where there is nothing whole."""
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return Solved(**arrays)
    except (OSError, ValueError, TypeError, EOFError, zipfile.BadZipFile):
        return None
