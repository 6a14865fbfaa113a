"""The ground station's configuration; `station.toml` beside this file is its commented form.

`python -m ground_station.service.settings FILE` checks the file alone: what it names, maps and
keys, may not be there yet when the service is installed.
"""

from __future__ import annotations

import dataclasses
import json
import re
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from ground_station.localization.settings import preset_file
from pi_firmware.wire import video
from pi_firmware.wire.config import apply_override, from_mapping, key, read, table
from pi_firmware.wire.errors import ConfigError, TelemetryError
from pi_firmware.wire.keys import check_payload_id
from pi_firmware.wire.telemetry import LOCAL_ENDPOINT, check_endpoint

SHIPPED = Path(__file__).with_name("station.toml")
SAMPLE = Path(__file__).parents[2] / "maps" / "atrium"
"""The map that ships, with the flight that `--demo` plays as the payload `DEMO_PAYLOAD`."""
DEMO_PAYLOAD = "demo"
RUN_FILE = "station.json"
FLEET_PORT = 7448
"""Where other stations join."""


MAP_NAME = r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}"


@dataclass(frozen=True)
class MapSettings:
    """Where poses are in."""

    folder: str = "maps/atrium"
    shelf: str = "maps"
    camera: str = ""

    def folder_of(self, name: object) -> Path | None:
        """Where the map of a name lies, on the shelf or as the configured one; else None.

        None, too, for what is no plain name, and for a link that leads off the shelf.
        """
        if not isinstance(name, str) or not re.fullmatch(MAP_NAME, name):
            return None
        shelf, configured = Path(self.shelf), Path(self.folder)
        folder = shelf / name
        if (folder / "map.toml").is_file() and folder.resolve().parent == shelf.resolve():
            return folder
        if configured.name == name and (configured / "map.toml").is_file():
            return configured
        return None


@dataclass(frozen=True)
class PayloadSettings:
    """Who is taken up."""

    ids: list[str] = key([])
    most: int = key(4, low=1, high=16)
    apart_m: float = key(1.5, unit="m", low=0, high=100)


@dataclass(frozen=True)
class VideoSettings:
    """Where the video comes in."""

    host: str = "127.0.0.1"
    port: int = key(video.PORT, low=0, high=65535)


def _check_endpoints(endpoints: Iterable[str], of: str, certified: bool) -> None:
    try:
        for endpoint in endpoints:
            check_endpoint(endpoint, certified=certified)
    except TelemetryError as error:
        raise ValueError(str(error).replace("telemetry", of, 1)) from None


@dataclass(frozen=True)
class TelemetrySettings:
    """Zenoh with the payloads."""

    listen: list[str] = key([LOCAL_ENDPOINT])
    connect: list[str] = key([])
    certificates: str = ""
    discoverable: str = ""

    def __post_init__(self) -> None:
        _check_endpoints((*self.listen, *self.connect), "telemetry", bool(self.certificates))


@dataclass(frozen=True)
class FleetSettings:
    """Other stations of the same authority, which show each other's payloads."""

    listen: list[str] = key([])
    join: list[str] = key([])

    def __post_init__(self) -> None:
        _check_endpoints((*self.listen, *self.join), "fleet", certified=True)


@dataclass(frozen=True)
class LocalizerSettings:
    """How poses are found."""

    preset: str = "default"

    def __post_init__(self) -> None:
        try:
            preset_file(self.preset)
        except ConfigError as error:
            raise ValueError(str(error)) from None


@dataclass(frozen=True)
class RecordingSettings:
    """The ground's recordings."""

    folder: str = "recordings"
    at_start: bool = False
    resume_s: float = key(600.0, unit="s", low=0, high=86_400)
    max_file_MB: int = key(1024, unit="MB", low=1, high=4000)
    max_file_s: float = key(3600.0, unit="s", low=10, high=86_400)
    max_total_MB: int = key(20_000, unit="MB", low=1, high=10_000_000)
    min_free_MB: int = key(1024, unit="MB", low=0, high=10_000_000)
    sync_s: float = key(1.0, unit="s", low=0.1, high=60)


@dataclass(frozen=True)
class HttpSettings:
    """The dashboard and the API."""

    host: str = "127.0.0.1"
    port: int = key(8080, low=0, high=65535)
    token_file: str = ""
    names: list[str] = key([])
    video_rate_hz: float = key(15.0, unit="Hz", low=1, high=60)
    jpeg_quality: int = key(80, low=10, high=100)
    viewers: int = key(8, low=1, high=100)


@dataclass(frozen=True)
class FoxgloveSettings:
    """The live channel for Foxglove."""

    enabled: bool = True
    host: str = "127.0.0.1"
    port: int = key(8765, low=0, high=65535)

    def __post_init__(self) -> None:
        if self.host not in ("127.0.0.1", "::1", "localhost"):
            raise ValueError(
                f"'foxglove.host' is {self.host!r}; only loopback: Foxglove's protocol has no"
                " token, take a tunnel such as ssh -L"
            )


@dataclass(frozen=True)
class StationSettings:
    """All of `station.toml`."""

    name: str = "main"
    map: MapSettings = table(MapSettings)
    payloads: PayloadSettings = table(PayloadSettings)
    video: VideoSettings = table(VideoSettings)
    telemetry: TelemetrySettings = table(TelemetrySettings)
    localizer: LocalizerSettings = table(LocalizerSettings)
    recording: RecordingSettings = table(RecordingSettings)
    http: HttpSettings = table(HttpSettings)
    foxglove: FoxgloveSettings = table(FoxgloveSettings)
    fleet: FleetSettings = table(FleetSettings)

    def __post_init__(self) -> None:
        if (self.fleet.listen or self.fleet.join) and not self.telemetry.certificates:
            raise ValueError("'fleet' needs 'telemetry.certificates' (blimp keys); --lan sets them")
        try:
            for name in (self.name, *self.payloads.ids):
                check_payload_id(name)
        except TelemetryError as error:
            raise ValueError(str(error).replace("payload_id", "the name", 1)) from None


@dataclass(frozen=True)
class Run:
    """One run of the service as its processes read it: settings, and what is replayed with it."""

    station: StationSettings = table(StationSettings)
    demo: bool = False
    started_ns: int = key(0, unit="ns")
    stepped: bool = False
    start: str = ""
    landmarks: bool = False


def load(path: Path | None, overrides: Iterable[str] = ()) -> StationSettings:
    """The settings from a file (the defaults without one) with `key.sub=value` on top of it.

    Raises `ConfigError` with one line.
    """
    document = {} if path is None else read(path)
    for override in overrides:
        apply_override(document, override, StationSettings)
    return from_mapping(document, StationSettings, where=str(path or "defaults"))


def write_run(folder: Path, run: Run) -> None:
    """Puts a run's settings where its processes find them."""
    (folder / RUN_FILE).write_text(json.dumps(dataclasses.asdict(run)))


def load_run(folder: Path) -> Run:
    """The settings of the run in a folder; raises `ConfigError` with one line."""
    path = folder / RUN_FILE
    try:
        return from_mapping(json.loads(path.read_bytes()), Run, where=str(path))
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}") from None
    except ValueError:
        raise ConfigError(f"{path}: not JSON text") from None


if __name__ == "__main__":
    try:
        load(Path(sys.argv[1]))
    except ConfigError as error:
        sys.exit(f"settings: {error}")
