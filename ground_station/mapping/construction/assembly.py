"""The map in memory, from a model and the features that it was made of."""

from __future__ import annotations

import numpy as np

from ground_station.geometry.camera import Camera
from ground_station.map import landmarks, store
from ground_station.map.model import Model
from ground_station.mapping.construction.feature_file import Lazily
from ground_station.mapping.construction.images import Images, extractor_of
from ground_station.mapping.settings import MappingSettings


def assemble(
    model: Model, images: Images, camera: Camera, settings: MappingSettings, name: str
) -> store.Map:
    """The map in memory from a refined model and the features it was made of."""
    extracted = extractor_of(settings)
    order = np.lexsort((model.feature, model.image))
    offset = np.searchsorted(model.image[order], np.arange(len(model.names) + 1))
    # Images have id = index + 1 in the database, and their features may lie on disk.
    observations = np.split(order, offset[1:-1])
    index = (model.image_id - 1).tolist()
    described = Lazily(
        len(index),
        lambda k: (
            observations[k],
            images.features[index[k]].descriptors[model.feature[observations[k]]],
        ),
    )
    pixels = np.concatenate(
        [
            images.features[i].keypoints_px[model.feature[mine]]
            for i, mine in zip(index, observations, strict=True)
        ]
    )
    keyframes = store.Keyframes(
        names=model.names,
        time_ns=images.time_ns[model.image_id - 1],
        wTc=model.wTc,
        offset=offset.astype(np.int64),
        landmark=model.point[order].astype(np.int32),
        pixel_px=pixels.astype(np.float32),
    )
    info = store.MapInfo(
        features=extracted.name,
        features_sha256=extracted.sha256,
        dimension=extracted.dimension,
        camera=camera,
        name=name,
    )
    return store.Map(info, landmarks.landmarks_of_blocks(model, described), keyframes)
