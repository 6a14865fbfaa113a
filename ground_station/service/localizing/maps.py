"""Maps for a running localizer, loaded beside the frames."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field, replace
from pathlib import Path

from ground_station.errors import MapError
from ground_station.localization.extraction import extractor_for
from ground_station.localization.localizer import Localizer
from ground_station.localization.settings import LocalizerSettings, for_live, load_preset
from ground_station.map import store
from ground_station.service.cameras import camera_of
from ground_station.service.settings import Run
from pi_firmware.wire.errors import BlimpError


def settings_of(run: Run) -> LocalizerSettings:
    """The localizer's settings in a run: the preset's, for live frames.

    It finds its first pose in the whole map whatever the preset says, where nobody tells it one;
    and where a payload waits for poses it describes keyframes in their turn, so that no clock
    decides anything. Raises `ConfigError` for a preset that is not there.
    """
    chosen = load_preset(run.station.localizer.preset)
    if not run.start:
        chosen = replace(chosen, recovery=replace(chosen.recovery, relocalize=True))
    return chosen if run.stepped else for_live(chosen)


def prepare(folder: Path, run: Run) -> Localizer:
    """A localizer in a map.

    Raises a `BlimpError` with one line: a map that is broken, not registered or of other features.
    """
    settings = settings_of(run)
    map_ = store.load(folder)
    if not map_.info.registered:
        raise MapError(f"{folder}: it is not registered, so its poses are not in metres")
    camera = camera_of(run.station.map, map_.info)
    return Localizer(map_, camera, extractor_for(map_.info, settings.features), settings)


@dataclass
class Loading:
    """A map on its way; `localizer` or `refused` is there once `ready` is set.

    `taken` is set when the process uses it or has said why not.
    """

    folder: Path
    localizer: Localizer | None = None
    refused: str = ""
    ready: threading.Event = field(default_factory=threading.Event)
    taken: threading.Event = field(default_factory=threading.Event)

    @property
    def name(self) -> str:
        """The folder's own."""
        return self.folder.resolve().name


class Loader:
    """Loads one map at a time, on a thread of its own; safe from any thread."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._lock = threading.Lock()
        self._loading: Loading | None = None

    def begin(self, folder: Path) -> Loading:
        """Starts loading; raises `MapError` while another is under way."""
        with self._lock:
            if self._loading is not None:
                raise MapError(f"the map '{self._loading.name}' is being loaded; try again then")
            loading = self._loading = Loading(folder)
        threading.Thread(target=self._load, args=(loading,), name="map", daemon=True).start()
        return loading

    def landed(self) -> Loading | None:
        """One that is ready, once."""
        with self._lock:
            loading = self._loading
            if loading is None or not loading.ready.is_set():
                return None
            self._loading = None
            return loading

    def _load(self, loading: Loading) -> None:
        try:
            loading.localizer = prepare(loading.folder, self._run)
        except BlimpError as error:
            loading.refused = str(error)
        except Exception as error:  # as too little memory: the map in use stays
            loading.refused = f"{loading.folder}: {type(error).__name__}: {error}"
        loading.ready.set()
