"""A user's weights become a model of the catalogue."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ground_station import files
from ground_station.feature_models import alike, scale, superpoint, torch_file
from ground_station.feature_models.torch_file import WeightsError
from ground_station.features import catalogue, extractors, inspection
from ground_station.features.extractor import FeatureError
from ground_station.features.model_info import Model, ModelInfo
from pi_firmware.wire.errors import os_errors_as

_NETWORKS = (superpoint, alike)


def import_weights(path: str | Path, name: str | None = None, licence: str | None = None) -> Model:
    """Reads SuperPoint's or ALIKE's weights and adds the model to the user's folder.

    `name` and `licence` are the network's own where they are not given. Raises `FeatureError` with
    one line for weights that are not what they should be, and for a name that is taken.
    """
    weights = torch_file.read(path)
    for network in _NETWORKS:
        if network.recognises(weights):
            graph, info = network.build(weights)
            break
    else:
        first = next(iter(weights.tensors))
        raise WeightsError(
            f"{path}: neither SuperPoint nor ALIKE: of its {len(weights.tensors)} tensors the "
            f"first is {first:.60}"
        )
    info = replace(
        info,
        name=name or info.name,
        licence=licence or info.licence,
        source=f"{info.source}; weights sha256 {weights.sha256[:16]}",
    )
    data = graph.model(info)
    inspection.check(inspection.parse(data), info)
    info = replace(info, distance_scale=scale.measured(data, info))
    return add(graph.model(info), info)


def add(data: bytes, info: ModelInfo) -> Model:
    """Adds a model's file to the user's folder.

    The same file again changes nothing; raises `FeatureError` where another model has the name.
    """
    extractors.check_free(info.name)
    inspection.check(inspection.parse(data), info)
    path = catalogue.path_for(info.name)
    with os_errors_as(path, FeatureError):
        for taken in (catalogue.SHIPPED / path.name, path):
            if taken.exists() and taken.read_bytes() != data:
                raise FeatureError(
                    f"there is another model '{info.name}', {taken}; maps know models by name, so "
                    "choose another one or take that file away"
                )
        path.parent.mkdir(parents=True, exist_ok=True)
    files.write_bytes(path, data)
    return inspection.read(path)
