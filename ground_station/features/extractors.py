"""The extractors by name."""

from __future__ import annotations

from collections.abc import Callable

from ground_station.features.extractor import Extractor, FeatureError
from ground_station.features.rootsift import RootSift

_EXTRACTORS: dict[str, Callable[[int], Extractor]] = {"rootsift": RootSift}


def create(name: str, max_features: int = 1500) -> Extractor:
    """The extractor of that name, keeping at most `max_features` key points an image.

    Raises `FeatureError` naming those there are.
    """
    if name not in _EXTRACTORS:
        known = ", ".join(names())
        raise FeatureError(f"features: there is no extractor '{name}' (known: {known})")
    return _EXTRACTORS[name](max_features)


def names() -> list[str]:
    """The names that `create` knows."""
    return sorted(_EXTRACTORS)
