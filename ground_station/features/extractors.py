"""The extractors by name: methods, and the models of the catalogue."""

from __future__ import annotations

import functools
import importlib
import pkgutil
from collections.abc import Callable
from typing import TYPE_CHECKING

from ground_station.features import catalogue, methods
from ground_station.features.extractor import Extractor, FeatureError
from ground_station.features.settings import LearnedSettings

if TYPE_CHECKING:
    from ground_station.features.inference import Network

_IMPORTABLE = ("superpoint", "alike")
"""How the networks are called that `blimp models import` knows."""


def _method(name: str, max_features: int) -> Extractor:
    module = importlib.import_module(f"{methods.__name__}.{name}")
    extractor: Extractor = module.METHOD(max_features)
    return extractor


METHODS: dict[str, Callable[[int], Extractor]] = {
    module.name: functools.partial(_method, module.name)
    for module in pkgutil.iter_modules(methods.__path__)
}
"""What makes each, keeping at most so many key points."""
_DEFAULT = LearnedSettings()


def create(
    name: str,
    max_features: int = 1500,
    *,
    learned: LearnedSettings = _DEFAULT,
    threads: int = 1,
) -> Extractor:
    """The extractor of that name, keeping at most `max_features` key points an image.

    A name that is no method's is a model's; `learned` and `threads` (0: all cores but the
    tracker's) say how its network runs, which is warm when this returns. Raises `FeatureError`
    naming those there are, and as `catalogue.find` and `Network` do.
    """
    if name in METHODS:
        return METHODS[name](max_features)
    if name not in catalogue.names():
        known = ", ".join(names())
        bring = ""
        if name.startswith(_IMPORTABLE):
            bring = "; its weights do not ship, bring your own: blimp models import FILE"
        raise FeatureError(f"features: there is no extractor '{name:.80}' (known: {known}){bring}")
    # onnxruntime and onnx take half a second to import, which only models need.
    from ground_station.features.inference import Network, threads_beside_tracker

    model = catalogue.find(name)
    network = Network(model, learned.provider, threads or threads_beside_tracker())
    return of_network(network, max_features, learned)


def of_network(
    network: Network, max_features: int = 1500, learned: LearnedSettings = _DEFAULT
) -> Extractor:
    """The extractor over a network, by the layout of its model."""
    from ground_station.features.blobs import BlobFeatures
    from ground_station.features.learned import CellFeatures, PixelFeatures

    kinds: dict[str, Callable[[Network, int, LearnedSettings], Extractor]] = {
        "blobs": BlobFeatures,
        "cells": CellFeatures,
        "pixels": PixelFeatures,
    }
    return kinds[network.model.info.layout](network, max_features, learned)


def names() -> list[str]:
    """The names that `create` knows."""
    return sorted({*METHODS, *catalogue.names()})


def check_free(name: str) -> None:
    """Raises `FeatureError` unless a new model may have that name: well formed, and no method's."""
    from ground_station.features.model_info import check_name

    check_name(name)
    if name in METHODS or name == "map":
        raise FeatureError(f"name is '{name}', which is a method's; give the model another")
