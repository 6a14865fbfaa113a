"""The map in memory, from a model and the features that it was made of."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from ground_station.geometry.camera import Camera
from ground_station.mapping import landmarks, store
from ground_station.mapping.construction.images import Images, extractor_of
from ground_station.mapping.settings import MappingSettings
from ground_station.mapping.sfm import colmap

F64 = npt.NDArray[np.float64]


def assemble(
    model: colmap.Model, images: Images, camera: Camera, settings: MappingSettings, name: str
) -> store.Map:
    """The map in memory from a refined model and the features it was made of."""
    extracted = extractor_of(settings)
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
