"""From frames to a map: features, matches, structure from motion, landmarks."""

from __future__ import annotations

import hashlib
import os
import shutil
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from ground_station.arrays import F64, U16
from ground_station.errors import MapError
from ground_station.geometry.camera import Camera
from ground_station.map import colmap, colmap_files, landmarks, store
from ground_station.map.folder import replacing
from ground_station.map.model import Model
from ground_station.mapping.construction import bending, content, noise
from ground_station.mapping.construction.assembly import assemble
from ground_station.mapping.construction.cache import Cache
from ground_station.mapping.construction.first_lens import LensPrior
from ground_station.mapping.construction.images import Images, extract
from ground_station.mapping.construction.lens import SelfCalibration, with_lens
from ground_station.mapping.construction.pairs import Pair
from ground_station.mapping.construction.parts.reconstruction import reconstruct
from ground_station.mapping.construction.structure import Structure, adjust_and_filter
from ground_station.mapping.construction.verification import match
from ground_station.mapping.construction.work import lasting
from ground_station.mapping.construction.workers import Threads, Workers
from ground_station.mapping.refinement.refine import straighten
from ground_station.mapping.settings import MappingSettings
from ground_station.mapping.sfm.two_view import TwoView
from ground_station.recording.frames import Frame

_STRUCTURE = b"blimp structure 4\n"
"""Counted on as those of `content` are."""


@dataclass(frozen=True)
class _Round:
    """What a build has made with one lens."""

    images: Images
    pairs: dict[Pair, TwoView]
    camera: Camera
    limits: MappingSettings
    noise: noise.Noise | None
    structure: Structure
    model: Model

    def places(self) -> list[dict[int, F64]]:
        """Of each model, the poses (4, 4) of its images, by COLMAP's id."""
        models = [self.model, *map(colmap.to_arrays, self.structure.parts)]
        return [dict(zip(one.image_id.tolist(), one.wTc, strict=True)) for one in models]


def build_map(
    frames: Iterable[Frame],
    camera: Camera,
    settings: MappingSettings,
    out: str | Path,
    *,
    prior: LensPrior | None = None,
    total: int | None = None,
    built: dict[str, Any] | None = None,
    cache: Cache | None = None,
    workers: Workers | None = None,
) -> store.Map:
    """Builds a map from frames in the folder `out`; a killed build leaves the old map there.

    `prior` says how well the camera is known; None: it is calibrated. A lens that nobody calibrated
    is found by the images, and so is one that misfits, where the images decide; the map holds it
    then. `total` is the number of frames if known, `built` what map.toml shall say of the inputs.
    The rolling shutter of the camera is taken out of the finished map. What is worth a note stands
    in its `info.built["notes"]`. With a `cache`, what an earlier build has made is not made again,
    one that was killed included. `workers` extract and match, by default threads of this process.
    Raises `InputError` when there are fewer than two frames, `MapError` when sizes differ from the
    camera's, images do not overlap, structure from motion fails, or nobody calibrated the lens and
    the images leave it open.
    """
    out = Path(out)
    threads = settings.threads or os.cpu_count() or 1
    workers = workers or Threads(threads)
    stage_s: dict[str, float] = {}
    # What lasts is let go of only when the map is in its place.
    with ExitStack() as own, replacing(out) as folder:
        with _timed(stage_s, "features"):
            images = extract(
                frames, camera, settings, workers, total, cache=cache, folder=folder / "work",
            )  # fmt: skip
        # A camera that somebody gives without a word on its lens is a calibrated one.
        lens = SelfCalibration(prior or LensPrior(camera, "file", 0.0), images, settings)
        rounds: list[_Round] = []
        matched: dict[Pair, U16] = {}
        going = True
        while going:
            if lens.camera != camera:
                camera, images = lens.camera, with_lens(images, lens.camera)
            limits = lens.settings(settings)
            with _timed(stage_s, "match"):
                seen = noise.measured(images, camera, limits.match.of(limits.features).ratio)
                limits = _with_noise(limits, seen)
                pairs = match(images, camera, limits, workers, cache=cache, matched=matched)
            work = None
            if cache:
                key = structure_key(images, pairs, camera, limits)
                work = own.enter_context(lasting(cache.folder / "work", key))
            if work is None:
                work = folder / "work" / str(lens.rounds)
                work.mkdir(parents=True)
            try:
                with _timed(stage_s, "sfm"), _colmap_in(work):
                    structure = reconstruct(
                        images, pairs, camera, limits, threads, work, workers,
                        rounds[-1].places() if rounds else (),
                    )  # fmt: skip
                with _timed(stage_s, "refine"):
                    model = adjust_and_filter(structure.reconstruction, limits.sfm, threads)
            except MapError as error:
                lens.failed(error)
                break
            # The first is of the known lens, to which a build may come back.
            rounds[1:] = [_Round(images, pairs, camera, limits, seen, structure, model)]
            with _timed(stage_s, "lens"):
                going = lens.go_on(model, images)
        made = rounds[-1] if rounds[-1].camera == lens.camera else rounds[0]
        images, pairs, camera, limits, seen = (
            made.images, made.pairs, made.camera, made.limits, made.noise
        )  # fmt: skip
        structure, model = made.structure, made.model
        notes = _notes(len(images.names), len(model.names), structure)
        map_ = assemble(model, images, camera, settings, out.name)
        map_.info.built = {
            **(built or {}),
            "images": len(images.names),
            "registered": len(model.names),
            "model_sizes": [len(model.names), *structure.sizes[1:]],
            "dropped": structure.dropped,
            "left_out": _left_out(images, pairs, structure, model.names),
            "parts": _parts(images, structure, model.names),
            "doubts": structure.doubts,
            "notes": notes,
            **(
                {"noise_px": seen.sigma_px, "match_error_px": limits.match.error_px} if seen else {}
            ),
            "lens": lens.as_built(),
            "sigma_px": landmarks.sigma_px(model),
            "reprojection_px": float(np.linalg.norm(landmarks.residuals_px(model), axis=1).mean()),
            "observations": len(model.point),
            "pairs_verified": len(pairs),
            "sparse_camera": "the one in [camera]; key points are those of the pictures",
            "threads": threads,
            "workers": workers.name,
            **({"cache": asdict(cache.figures)} if cache else {}),
            "stage_s": {name: round(value, 3) for name, value in stage_s.items()},
            "settings": asdict(settings),
        }
        map_, straight = _straightened(map_, model, limits)
        sparse = colmap.from_arrays(straight, camera)
        if len(model.names) <= limits.sfm.part_images:  # of more its cost is not measured
            map_.landmarks.by_focal_m = bending.by_focal(
                sparse, map_.landmarks.id, loss_px=limits.sfm.loss_px, threads=threads
            )
        colmap.write(sparse, folder / "sparse")
        colmap_files.check(folder / "sparse")  # COLMAP does not say when the disk is full
        store.save_tables(folder, map_)
        shutil.rmtree(folder / "work", ignore_errors=True)
    map_.folder = out
    return map_


def structure_key(
    images: Images,
    pairs: Mapping[Pair, TwoView],
    camera: Camera,
    settings: MappingSettings,
) -> str:
    """The hash, as text, of all that structure from motion starts from, its seed included."""
    digest = hashlib.sha256(_STRUCTURE)
    document = {
        "names": images.names,
        "camera": camera.as_dict(),
        "sfm": asdict(settings.sfm),
        "match": asdict(settings.match),
        "seed": settings.seed,
        "pycolmap": version("pycolmap"),
        "pairs": [[i, j, len(v.matches), v.degenerate] for (i, j), v in sorted(pairs.items())],
        "keypoints": [len(pixels) for pixels in images.pinhole_px],
    }
    digest.update(content.line(document))
    digest.update(images.time_ns.tobytes())
    for pixels in images.pinhole_px:
        digest.update(pixels.tobytes())
    for _, view in sorted(pairs.items()):
        for array in (view.matches, view.essential, view.homography):
            digest.update(b"none" if array is None else array.tobytes())
    return digest.hexdigest()


def _straightened(
    map_: store.Map, model: Model, settings: MappingSettings
) -> tuple[store.Map, Model]:
    """The map without its camera's rolling shutter, and the model that goes with it.

    One that cannot be adjusted stays as it is, and a note says so.
    """
    try:
        return straighten(map_, settings) or (map_, model)
    except MapError as error:
        map_.info.built["notes"].append(f"the rolling shutter stays in the map: {error}")
        return map_, model


@contextmanager
def _timed(stage_s: dict[str, float], name: str) -> Iterator[None]:
    start_s = time.monotonic()
    yield
    stage_s[name] = stage_s.get(name, 0.0) + time.monotonic() - start_s


@contextmanager
def _colmap_in(work: Path) -> Iterator[None]:
    """Says in one line what COLMAP could not do: most likely, write its database there."""
    try:
        yield
    except RuntimeError as error:
        reason = " ".join(str(error).split())
        free_mb = shutil.disk_usage(work).free // 1_000_000
        raise MapError(
            f"{work}: structure from motion failed there, with {free_mb} MB free: {reason:.200}"
        ) from error


def _with_noise(settings: MappingSettings, found: noise.Noise | None) -> MappingSettings:
    """With the loss that the images' own noise asks for, and its limit where that is larger."""
    if found is None:
        return settings
    limit_px = max(found.limit_px, settings.match.error_px)
    settings = replace(settings, match=replace(settings.match, error_px=limit_px))
    return settings.with_noise(found.sigma_px)


def _parts(images: Images, structure: Structure, names: list[str]) -> list[list[str]]:
    """The names of each model's images, this map's first; empty where it is the only one."""
    others = [
        [images.names[image_id - 1] for image_id in sorted(part.reg_image_ids())]
        for part in structure.parts
    ]
    return [list(names), *others] if others else []


def _left_out(
    images: Images, pairs: Mapping[Pair, TwoView], structure: Structure, names: list[str]
) -> dict[str, str]:
    """Why each image that stands in no model has no place."""
    elsewhere = {image_id - 1 for part in structure.parts for image_id in part.reg_image_ids()}
    linked = {k for pair in pairs for k in pair}
    here, dropped = set(names), set(structure.dropped)
    reasons = {}
    for k, name in enumerate(images.names):
        if name in here or k in elsewhere:
            continue
        if name in dropped:
            reasons[name] = "where it fits, other images say that it does not belong"
        elif k in linked:
            reasons[name] = "too little of what it shows has a place"
        else:
            reasons[name] = "it shares nothing with another image"
    return reasons


def _notes(images: int, registered: int, structure: Structure) -> list[str]:
    sizes, dropped = structure.sizes, structure.dropped
    others = f", models of sizes {[registered, *sizes[1:]]}" if sizes[1:] else ", one model"
    notes = [f"{registered} of {images} images registered{others}"]
    if dropped:
        shown = ", ".join(dropped[:5]) + (", …" if len(dropped) > 5 else "")
        notes.append(
            f"{len(dropped)} images left out: where they fit, others say that they do not belong: "
            f"{shown}"
        )
    return notes + structure.notes
