"""From frames to a map: features, matches, structure from motion, landmarks."""

from __future__ import annotations

import itertools
import os
import shutil
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from ground_station.errors import InputError, MapError
from ground_station.features import extractors
from ground_station.features.extractor import Extractor, Features
from ground_station.features.rootsift import RootSift
from ground_station.geometry.camera import Camera
from ground_station.mapping import landmarks, store
from ground_station.mapping.construction.consistency import plausible_frames
from ground_station.mapping.construction.matching import TwoView, mutual_matches, verify
from ground_station.mapping.construction.pairs import choose_pairs
from ground_station.mapping.folder import replacing
from ground_station.mapping.settings import MappingSettings
from ground_station.mapping.sfm import colmap
from ground_station.progress import Progress
from ground_station.recording.frames import Frame

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
In = TypeVar("In")
Out = TypeVar("Out")


@dataclass(frozen=True)
class Images:
    """What is kept of n frames: names, times (n,), features, their undistorted pixels (N, 2)."""

    names: list[str]
    time_ns: I64
    features: list[Features]
    pinhole_px: list[F64]


def build_map(
    frames: Iterable[Frame],
    camera: Camera,
    settings: MappingSettings,
    out: str | Path,
    *,
    total: int | None = None,
    built: dict[str, Any] | None = None,
) -> store.Map:
    """Builds a map from frames in the folder `out`; a killed build leaves the old map there.

    `total` is the number of frames if known, `built` what map.toml shall say of the inputs. Raises
    `InputError` when there are fewer than two frames, `MapError` when sizes differ from the
    camera's, images do not overlap, or structure from motion fails.
    """
    out = Path(out)
    threads = settings.threads or os.cpu_count() or 1
    notes: list[str] = []
    stage_s: dict[str, float] = {}
    with replacing(out) as folder:
        images = extract(frames, camera, settings, threads, total, stage_s)
        pairs = match(images, camera, settings, threads, stage_s)
        work = folder / "work"
        work.mkdir()
        colmap.write_database(work / "database.db", camera, images.names, images.pinhole_px, pairs)
        with Progress("structure from motion, images", len(images.names)) as progress:
            models = colmap.incremental(
                work / "database.db",
                work / "models",
                seed=settings.seed,
                threads=threads,
                images=len(images.names),
                refine_camera=settings.sfm.refine_camera,
                min_tri_angle_deg=settings.sfm.min_tri_angle_deg,
                on_image=progress.step,
            )
        stage_s["sfm"] = progress.elapsed_s
        start_s = time.monotonic()
        reconstruction = models[0]
        dropped = _drop_implausible(reconstruction, images, settings.sfm.max_jump)
        if dropped:
            shown = ", ".join(dropped[:5]) + (", …" if len(dropped) > 5 else "")
            notes.append(f"{len(dropped)} images dropped, far off their neighbours: {shown}")
        model = refine(reconstruction, settings, threads)
        stage_s["refine"] = time.monotonic() - start_s
        sizes = [m.num_reg_images() for m in models[1:]]
        notes.insert(
            0,
            f"{len(model.names)} of {len(images.names)} images registered"
            + (f", models of sizes {[len(model.names), *sizes]}" if sizes else ", one model"),
        )
        for note in notes:
            print(note, flush=True)
        map_ = assemble(model, images, camera, settings, out.name)
        map_.info.built = {
            **(built or {}),
            "images": len(images.names),
            "registered": len(model.names),
            "model_sizes": [len(model.names), *sizes],
            "dropped": dropped,
            "notes": notes,
            "sigma_px": landmarks.sigma_px(model),
            "reprojection_px": float(np.linalg.norm(landmarks.residuals_px(model), axis=1).mean()),
            "observations": len(model.point),
            "pairs_verified": len(pairs),
            "sparse_camera": "PINHOLE; key points are undistorted, the lens is in [camera]",
            "threads": threads,
            "stage_s": {name: round(value, 3) for name, value in stage_s.items()},
            "settings": asdict(settings),
        }
        colmap.write(colmap.compact(reconstruction), folder / "sparse")
        store.save_tables(folder, map_, quantise=settings.quantise)
        shutil.rmtree(work)
    map_.folder = out
    return map_


def extract(
    frames: Iterable[Frame],
    camera: Camera,
    settings: MappingSettings,
    threads: int,
    total: int | None,
    stage_s: dict[str, float],
) -> Images:
    """Features of all frames, extracted in parallel while the input is read.

    Raises `InputError` for fewer than two frames, `MapError` for a size other than the camera's.
    """
    local = threading.local()
    size = (camera.height_px, camera.width_px)

    def one(frame: Frame) -> tuple[str, int, Features]:
        if frame.image.shape != size:
            height, width = frame.image.shape[:2]
            raise MapError(
                f"{frame.name}: is {width}x{height} pixels, "
                f"the camera {camera.width_px}x{camera.height_px}"
            )
        if not hasattr(local, "extractor"):  # an extractor of its own for each thread
            local.extractor = _extractor(settings)
        return frame.name, frame.time_ns, local.extractor.extract(frame.image)

    rows: list[tuple[str, int, Features]] = []
    with Progress("features, images", total) as progress:
        for row in parallel(one, frames, threads):
            rows.append(row)
            progress.step()
    stage_s["features"] = progress.elapsed_s
    if len(rows) < 2:
        raise InputError(f"a map needs at least 2 frames; the input has {len(rows)}")
    names = [row[0] for row in rows]
    if len(set(names)) != len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"two frames are named '{twice}'")
    return Images(
        names=names,
        time_ns=np.array([row[1] for row in rows], dtype=np.int64),
        features=[row[2] for row in rows],
        pinhole_px=[camera.undistort_to_pinhole(row[2].keypoints_px) for row in rows],
    )


def _extractor(settings: MappingSettings) -> Extractor:
    """As the settings say. A network gets one thread: pictures are described beside each other."""
    return extractors.create(settings.features, settings.max_features, learned=settings.learned)


def match(
    images: Images,
    camera: Camera,
    settings: MappingSettings,
    threads: int,
    stage_s: dict[str, float],
) -> dict[tuple[int, int], TwoView]:
    """Verified pairs (i, j) of images; raises `MapError` when no two images overlap."""
    descriptors = [features.descriptors for features in images.features]
    wanted = settings.match
    # Lowe's 0.8 is for SIFT. Of ALIKE's matches in the sample's mapping flight it leaves a third:
    # 47 verified pairs of 32 pictures, where 0.95 leaves 111.
    ratio = wanted.ratio if settings.features == RootSift.name else wanted.ratio_others
    matrix = camera.matrix

    def one(pair: tuple[int, int]) -> tuple[tuple[int, int], TwoView | None]:
        i, j = pair
        far = j - i > wanted.neighbours
        # Most pairs far apart share nothing, and a few of the strongest features tell: Wu,
        # "Towards linear-time incremental structure from motion", 3DV 2013, section 3.
        if far and wanted.preview:
            first, second = (descriptors[k][: wanted.preview] for k in pair)
            if len(mutual_matches(first, second, ratio)) < wanted.preview_matches:
                return pair, None
        matches = mutual_matches(descriptors[i], descriptors[j], ratio)
        least = wanted.min_inliers_far if far else wanted.min_inliers
        if len(matches) < least:
            return pair, None
        view = verify(
            images.pinhole_px[i],
            images.pinhole_px[j],
            matches,
            matrix,
            error_px=wanted.error_px,
            planar_ratio=wanted.planar_ratio,
        )
        if view is None or len(view.matches) < least:
            return pair, None
        # Repeated patterns look alike without sharing a geometry.
        if far and len(view.matches) < wanted.min_inlier_ratio * len(matches):
            return pair, None
        return pair, view

    pairs = choose_pairs(descriptors, wanted, settings.seed)
    verified: dict[tuple[int, int], TwoView] = {}
    with Progress("matching, pairs", len(pairs)) as progress:
        for pair, view in parallel(one, pairs, threads):
            if view is not None:
                verified[pair] = view
            progress.step()
    stage_s["match"] = progress.elapsed_s
    if not verified:
        raise MapError(
            f"no two of the {len(images.names)} images overlap: "
            f"no pair has {wanted.min_inliers} verified matches"
        )
    return verified


def refine(
    reconstruction: colmap.Reconstruction, settings: MappingSettings, threads: int
) -> colmap.Model:
    """Filters and adjusts a model until what is kept fits; raises `MapError` when nothing does.

    Robust bundle adjustment, then observations above `max_error_px` and points below `min_track`
    or `min_tri_angle_deg` go; twice, because the first round's outliers bend the second's poses.
    """
    sfm = settings.sfm
    for _ in range(2):
        colmap.adjust(
            reconstruction, loss_px=sfm.loss_px, refine_camera=sfm.refine_camera, threads=threads
        )
        model = colmap.to_arrays(reconstruction)
        error = np.linalg.norm(landmarks.residuals_px(model), axis=1)
        bad = error > sfm.max_error_px
        colmap.drop_observations(
            reconstruction, model.image_id[model.image[bad]], model.feature[bad]
        )
        model = colmap.to_arrays(reconstruction)
        weak = (np.bincount(model.point, minlength=len(model.position)) < sfm.min_track) | (
            landmarks.largest_angles_deg(model) < sfm.min_tri_angle_deg
        )
        colmap.drop_points(reconstruction, model.point_id[weak])
    model = colmap.to_arrays(reconstruction)
    if not len(model.point_id):
        raise MapError(
            f"no landmark is seen by {sfm.min_track} images at {sfm.min_tri_angle_deg} degrees: "
            "the camera must move more between images"
        )
    return model


def assemble(
    model: colmap.Model, images: Images, camera: Camera, settings: MappingSettings, name: str
) -> store.Map:
    """The map in memory from a refined model and the features it was made of."""
    extracted = _extractor(settings)
    source = model.image_id[model.image] - 1  # images have id = index + 1 in the database
    pick = [
        (images.features[i], f)
        for i, f in zip(source.tolist(), model.feature.tolist(), strict=True)
    ]
    descriptors = np.stack([features.descriptors[f] for features, f in pick])
    pixels = np.stack([features.keypoints_px[f] for features, f in pick])
    order = np.lexsort((model.feature, model.image))
    offset = np.searchsorted(model.image[order], np.arange(len(model.names) + 1))
    keyframes = store.Keyframes(
        names=model.names,
        time_ns=images.time_ns[model.image_id - 1],
        wTc=model.wTc,
        offset=offset.astype(np.int64),
        landmark=model.point[order].astype(np.int32),
        pixel_px=pixels[order].astype(np.float32),
    )
    if settings.sfm.refine_camera:
        camera = with_pinhole(camera, model.pinhole)
    info = store.MapInfo(
        features=extracted.name,
        features_sha256=extracted.sha256,
        dimension=extracted.dimension,
        camera=camera,
        name=name,
    )
    return store.Map(info, landmarks.make_landmarks(model, descriptors), keyframes)


def with_pinhole(camera: Camera, pinhole: Sequence[float] | F64) -> Camera:
    """The camera with other fx, fy, cx, cy whose undistorted rays are those of a refined pinhole.

    Key points were undistorted with the old lens, so a refined focal length scales the undistorted
    plane, and the lens has to follow: distortion is linear in k1, k2, p1, p2, k3, which are fitted
    over the image.
    """
    fx, fy, cx, cy = (float(value) for value in pinhole)
    u, v = np.meshgrid(
        np.linspace(0, camera.width_px - 1, 30), np.linspace(0, camera.height_px - 1, 30)
    )
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    x, y = ((camera.undistort_to_pinhole(pixels) - [cx, cy]) / [fx, fy]).T
    r2 = x * x + y * y
    columns = [r2, r2**2, 2 * x * y, r2 + 2 * x * x, r2**3]
    A = np.concatenate(
        [
            np.stack([x * r2, x * r2**2, columns[2], columns[3], x * r2**3], axis=1) * fx,
            np.stack([y * r2, y * r2**2, r2 + 2 * y * y, 2 * x * y, y * r2**3], axis=1) * fy,
        ]
    )
    b = np.concatenate([pixels[:, 0] - cx - fx * x, pixels[:, 1] - cy - fy * y])
    k1, k2, p1, p2, k3 = (float(value) for value in np.linalg.lstsq(A, b, rcond=None)[0])
    values = camera.as_dict() | {
        "fx_px": fx, "fy_px": fy, "cx_px": cx, "cy_px": cy,
        "k1": k1, "k2": k2, "p1": p1, "p2": p2, "k3": k3,
    }  # fmt: skip
    return Camera(**values)  # type: ignore[arg-type]


def parallel(function: Callable[[In], Out], items: Iterable[In], threads: int) -> Iterator[Out]:
    """`map` on a few threads, results in order, with a bounded number of items in memory."""
    waiting: deque[Future[Out]] = deque()
    iterator = iter(items)
    with ThreadPoolExecutor(threads) as pool:
        try:
            for item in itertools.islice(iterator, 4 * threads):
                waiting.append(pool.submit(function, item))
            while waiting:
                yield waiting.popleft().result()
                for item in itertools.islice(iterator, 1):
                    waiting.append(pool.submit(function, item))
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _drop_implausible(
    reconstruction: colmap.Reconstruction, images: Images, max_jump: float
) -> list[str]:
    model = colmap.to_arrays(reconstruction)
    rays = model.position[model.point] - model.wTc[model.image, :3, 3]
    depth = float(np.median(np.linalg.norm(rays, axis=1))) if len(rays) else 0.0
    keep = plausible_frames(
        images.time_ns[model.image_id - 1], model.wTc[:, :3, 3], depth, max_jump
    )
    colmap.drop_images(reconstruction, model.image_id[~keep].tolist())
    return [name for name, kept in zip(model.names, keep, strict=True) if not kept]
