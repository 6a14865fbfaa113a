"""The payloads' camera, which all processes of a service agree on."""

from __future__ import annotations

from pathlib import Path

from ground_station.geometry.camera import Camera, load_camera
from ground_station.map.store import MapInfo, load_info
from ground_station.service.settings import MapSettings


def camera_of(settings: MapSettings, map_: MapInfo | str | Path) -> Camera:
    """The one that is configured, or that of the map; raises a `BlimpError` with one line."""
    if settings.camera:
        return load_camera(settings.camera)
    return (map_ if isinstance(map_, MapInfo) else load_info(map_)).camera
