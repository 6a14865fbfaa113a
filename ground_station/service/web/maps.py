"""Maps for the dashboard: which there are, their floor plans, their landmarks in few points.

Only what is asked for is read, once, and kept until the file changes.
"""

from __future__ import annotations

import contextlib
import threading
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from fastapi import APIRouter, Request, Response

from ground_station.errors import MapError
from ground_station.service.settings import MapSettings
from ground_station.service.web.models import MapDetailsModel, MapModel, MapName
from ground_station.service.web.problems import NotFound, problems
from pi_firmware.wire.errors import BlimpError

if TYPE_CHECKING:
    from ground_station.map.store import MapInfo

LANDMARKS = 20_000
_KEPT = 16
_MAPS = 100
T = TypeVar("T")


class Maps:
    """The maps on the shelf and the configured one. Safe from any thread."""

    def __init__(self, settings: MapSettings) -> None:
        self._settings = settings
        self._lock = threading.Lock()
        self._kept: OrderedDict[tuple[str, str], tuple[tuple[int, ...], Any]] = OrderedDict()

    def names(self) -> list[str]:
        """All that can be asked for."""
        names: list[str] = []
        with contextlib.suppress(OSError):
            names = sorted(path.name for path in Path(self._settings.shelf).iterdir())[: 10 * _MAPS]
        names.append(Path(self._settings.folder).name)
        found = dict.fromkeys(name for name in names if self._settings.folder_of(name))
        return [*found][:_MAPS]

    def list(self) -> list[dict[str, Any]]:
        """All maps in short; one that cannot be read is left out."""
        result = []
        for name in self.names():
            try:
                details = self.details(name)
            except BlimpError:
                continue
            short = {key: details[key] for key in ("name", "registered", "landmarks", "extent_m")}
            result.append({**short, "floorplan": details["floorplan"] is not None})
        return result

    def details(self, name: str) -> dict[str, Any]:
        """One map; raises `NotFound`, or `MapError` for one that cannot be read."""
        folder = self.folder(name)

        def read() -> dict[str, Any]:
            from ground_station.map import store
            from ground_station.service.cameras import camera_of

            info = store.load_info(folder)
            positions = store.load_positions(folder)
            low = positions.min(axis=0) if len(positions) else np.zeros(3)
            high = positions.max(axis=0) if len(positions) else np.zeros(3)
            return {
                "name": name,
                "registered": info.registered,
                "landmarks": len(positions),
                "extent_m": (high - low).round(3).tolist(),
                "bounds": {"min": low.round(3).tolist(), "max": high.round(3).tolist()},
                "features": info.features,
                "camera": camera_of(self._settings, info).as_page(),
            }

        details = self._once(name, "details", ("map.toml", "landmarks.safetensors"), read)
        return {**details, "floorplan": self._plan(name)}

    def info(self, name: str) -> MapInfo:
        """What a map says of itself; raises `NotFound`, or `MapError` where it cannot be read."""
        from ground_station.map import store

        return self._once(name, "info", ("map.toml",), lambda: store.load_info(self.folder(name)))

    def floorplan(self, name: str) -> bytes:
        """The floor plan as PNG, of exactly the size that `details` tells."""
        plan = self._drawn(name)
        if plan is None:
            raise NotFound(f"the map {name!r} has no floor plan")
        return plan[1]

    def landmarks(self, name: str) -> bytes:
        """x, y, z of at most `LANDMARKS` landmarks, float32, little-endian, evenly drawn."""
        folder = self.folder(name)

        def read() -> bytes:
            from ground_station.map import store

            positions = store.load_positions(folder)
            if len(positions) > LANDMARKS:
                positions = positions[np.arange(LANDMARKS) * len(positions) // LANDMARKS]
            return positions.astype("<f4").tobytes()

        return self._once(name, "landmarks", ("landmarks.safetensors",), read)

    def _plan(self, name: str) -> dict[str, Any] | None:
        try:
            plan = self._drawn(name)
        except BlimpError:
            return None
        return None if plan is None else plan[0]

    def _drawn(self, name: str) -> tuple[dict[str, Any], bytes] | None:
        folder = self.folder(name)
        path = folder / "floorplan.yaml"
        if not path.is_file():
            return None

        def read() -> tuple[dict[str, Any], bytes]:
            import cv2

            from ground_station.map.floorplan import load_floorplan

            plan = load_floorplan(path)
            height, width = plan.image.shape
            done, png = cv2.imencode(".png", plan.image)
            if not done:
                raise MapError(f"{path}: its picture cannot be shown")
            document = {
                "resolution_m": plan.resolution_m,
                "origin": list(plan.origin),
                "width_px": width,
                "height_px": height,
                "url": f"/api/maps/{name}/floorplan.png",
            }
            return document, png.tobytes()

        return self._once(name, "floorplan", ("floorplan.yaml", "floorplan.png"), read)

    def folder(self, name: str) -> Path:
        """Where a map lies; raises `NotFound`."""
        folder = self._settings.folder_of(name)
        if folder is None:
            raise NotFound(f"there is no map {name[:64]!r}")
        return folder

    def _once(self, name: str, what: str, files: tuple[str, ...], read: Callable[[], T]) -> T:
        """What `read` gives, kept until one of the files is another."""
        identity: tuple[int, ...] = ()
        for file in files:
            try:
                found = (self.folder(name) / file).stat()
                identity += (found.st_ino, found.st_mtime_ns, found.st_size)
            except OSError:
                identity += (0, 0, 0)
        key = (name, what)
        with self._lock:  # two viewers that open a map read it once
            kept = self._kept.get(key)
            if kept is None or kept[0] != identity:
                kept = self._kept[key] = (identity, read())
            self._kept.move_to_end(key)
            while len(self._kept) > _KEPT * 3:
                self._kept.popitem(last=False)
            value: T = kept[1]
            return value


def router(maps: Maps) -> APIRouter:
    """Maps over HTTP."""
    result = APIRouter(prefix="/api/maps", tags=["maps"])

    @result.get("", response_model=list[MapModel])
    def all_maps() -> Any:
        """The maps that can be chosen."""
        return maps.list()

    @result.get("/{name}", response_model=MapDetailsModel, responses=problems(404, 409))
    def one_map(name: MapName) -> Any:
        """A map's floor plan and bounds."""
        return maps.details(name)

    @result.get(
        "/{name}/floorplan.png",
        response_class=Response,
        responses={200: {"content": {"image/png": {}}}, **problems(404, 409)},
    )
    def floorplan(name: MapName, request: Request) -> Response:
        """The floor plan's picture."""
        return _with_tag(request, maps.floorplan(name), "image/png")

    @result.get(
        "/{name}/landmarks",
        response_class=Response,
        responses={200: {"content": {"application/octet-stream": {}}}, **problems(404, 409)},
    )
    def landmarks(name: MapName, request: Request) -> Response:
        """Landmarks as rows of three little-endian float32: x, y, z, metres."""
        return _with_tag(request, maps.landmarks(name), "application/octet-stream")

    return result


def _with_tag(request: Request, body: bytes, kind: str) -> Response:
    """Bytes with an ETag; none of them where the client has the same."""
    import hashlib

    tag = f'"{hashlib.sha256(body).hexdigest()[:24]}"'
    if request.headers.get("if-none-match") == tag:
        return Response(status_code=304, headers={"etag": tag})
    return Response(body, media_type=kind, headers={"etag": tag})
