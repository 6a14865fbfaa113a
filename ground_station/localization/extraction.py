"""The extractor that a localizer describes frames with in a map."""

from __future__ import annotations

from ground_station.errors import MapError
from ground_station.features import extractors
from ground_station.features.extractor import Extractor
from ground_station.features.settings import OF_THE_MAP, FeatureSettings
from ground_station.map.store import MapInfo, check_features


def extractor_for(info: MapInfo, settings: FeatureSettings) -> Extractor:
    """The settings' extractor, or the one with which the map was built where they say `map`.

    Raises `MapError` when the map was built with other features than the settings', with ones that
    are not here, or with another model of that name; `FeatureError` as `extractors.create` does.
    """
    name = settings.extractor
    if name == OF_THE_MAP:
        name, known = info.features, extractors.names()
        if name not in known:
            raise MapError(
                f"the map '{info.name}' was built with '{name:.80}' "
                f"({info.features_sha256[:12]}), which is not here (there are: {', '.join(known)})"
            )
    made = extractors.create(
        name, settings.max_features, learned=settings.learned, threads=settings.threads
    )
    check_features(info, made.name, made.sha256)
    return made
