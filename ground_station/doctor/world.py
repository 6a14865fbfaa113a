"""Checks of what the service works with: the map and its features, the certificates."""

from __future__ import annotations

import datetime
import json
import time
from collections.abc import Iterator
from pathlib import Path

from ground_station import user_folders
from ground_station.doctor.findings import Finding, ok, problem, warning
from ground_station.errors import GroundStationError
from ground_station.service import lan
from ground_station.service.settings import MapSettings, StationSettings
from pi_firmware.wire import credentials
from pi_firmware.wire.errors import BlimpError
from pi_firmware.wire.telemetry import is_loopback

_SOON = datetime.timedelta(days=30)


def maps(settings: MapSettings, preset: str) -> Iterator[Finding]:
    """The map loads, is registered, fits the localizer's features, and has a floor plan."""
    from ground_station.map import store

    folder = Path(settings.folder)
    choose = "set map.folder to a registered map (blimp map info MAP)"
    try:
        map_ = store.load(folder)
    except GroundStationError as error:
        yield problem("map", str(error), f"{choose}, or copy it here again")
        return
    name, points = map_.info.name, len(map_.landmarks)
    if not map_.info.registered:
        fix = f"blimp map register {folder} --pairs PAIRS.csv"
        yield problem("map", f"'{name}' is not registered to a floor plan", fix)
    elif not points:
        yield problem("map", f"'{name}' has no landmarks", choose)
    else:
        yield ok(
            "map", f"'{name}': {points} landmarks, {len(map_.keyframes)} keyframes, registered"
        )
    yield _features(map_.info, preset, folder)
    yield _floorplan(folder)
    if settings.camera:
        yield _camera(Path(settings.camera))


def _features(info, preset: str, folder: Path) -> Finding:  # type: ignore[no-untyped-def]
    """The extractor is there, with its model where it has one, and made the map's descriptors."""
    from ground_station.localization.extraction import extractor_for
    from ground_station.localization.settings import load_preset

    try:
        extractor = extractor_for(info, load_preset(preset).features)
    except GroundStationError as error:
        fix = (
            f"bring that model (blimp models), or build {folder} again with features that are here "
            "(blimp map build --features NAME)"
        )
        return problem("features", str(error), fix)
    found = f"'{extractor.name}' ({extractor.sha256[:12]}), the map's; preset '{preset}'"
    return ok("features", found)


def _floorplan(folder: Path) -> Finding:
    from ground_station.map.floorplan import load_floorplan

    path = folder / "floorplan.yaml"
    if not path.exists():
        fix = f"put floorplan.yaml and its picture, in ROS map_server's form, into {folder}"
        return warning("floor plan", "the map has none; the dashboard draws landmarks only", fix)
    try:
        plan = load_floorplan(path)
    except BlimpError as error:
        return problem("floor plan", str(error), f"fix {path}, or take it away")
    width_m, height_m = plan.size_m
    return ok("floor plan", f"{width_m:.1f} x {height_m:.1f} m at {plan.resolution_m:g} m a pixel")


def _camera(path: Path) -> Finding:
    from ground_station.geometry.camera import Camera
    from pi_firmware.wire import config

    try:
        camera = config.load(path, Camera)
    except BlimpError as error:
        return problem("camera", str(error), "set map.camera to a camera.toml; empty: the map's")
    return ok("camera", f"{path}: {camera.width_px}x{camera.height_px}")


def certificate(settings: StationSettings) -> Finding:
    """This station's certificate is its own, signed, valid for a while, and nobody else's to read.

    Without one only loopback may be spoken to.
    """
    from ground_station.keys.authority import inspect

    text, name = settings.telemetry.certificates, "certificate"
    if not text:
        if is_loopback(settings.video.host):
            return ok(name, "none: telemetry and video on loopback only")
        found = f"none, and video.host is {settings.video.host}: plain RTP can be forged"
        fix = f"blimp keys ground {settings.name}, then set telemetry.certificates"
        return warning(name, found, fix)
    again = f"copy the folder of 'blimp keys ground {settings.name}' here again"
    try:
        held = credentials.load(text)
        common, until = inspect(held.folder)
    except PermissionError as error:
        found = f"{error.filename}: not this user's to read"
        return warning(name, found, "run the doctor as the service's user: sudo -u blimp")
    except (BlimpError, OSError) as error:
        return problem(name, str(error), again)
    expected = f"{credentials.GROUND}.{settings.name}"
    if common != expected or held.name != expected:
        return problem(
            name, f"it is {common}'s, this station is {expected}", f"{again}, or set name"
        )
    return _lasting(held, until)


def cards(settings: StationSettings) -> Iterator[Finding]:
    """Each card that was written on this machine was told of this station.

    `make flash` leaves a note beside the payload's keys. Without certificates nothing is told.
    """
    text = settings.telemetry.certificates
    if not text:
        return
    # The folder may be a copy, as an installed service's is; notes are where the keys were made.
    for keys in dict.fromkeys((user_folders.data() / "keys", Path(text).resolve().parent.parent)):
        for path in sorted(keys.glob(f"{credentials.PAYLOAD}/*/{lan.CARD_NOTE}")):
            yield _card(path, f"{credentials.GROUND}.{settings.name}")


def _card(path: Path, station: str) -> Finding:
    payload = path.parent.name
    name = f"card of {payload}"
    try:
        note = json.loads(path.read_bytes())
        stations = ", ".join(map(str, note["peers"]))
        found = f"written on {time.strftime('%Y-%m-%d', time.gmtime(note['time_s']))}"
        is_told = station in note["peers"]
    except (OSError, ValueError, KeyError, TypeError):
        return warning(
            name, f"{path}: cannot be read", f"make flash PAYLOAD={payload} makes it again"
        )
    if is_told:
        return ok(name, f"{found}, for {stations}")
    fix = f"make flash PAYLOAD={payload} again, or set name to that station's"
    return problem(name, f"{found} for {stations}; this station is {station}", fix)


def _lasting(held: credentials.Credentials, until: datetime.datetime) -> Finding:
    """Of a good certificate: its end, its files' modes, and the keys of the payloads' video."""
    name, left = "certificate", until - datetime.datetime.now(datetime.UTC)
    if left <= datetime.timedelta(0):
        fix = "blimp keys rotate (three times, copying the folders between)"
        return problem(name, f"ended on {until:%Y-%m-%d}", fix)
    if open_ := [path for path in held.folder.rglob("*.key") if path.stat().st_mode & 0o077]:
        return problem(name, f"others can read {open_[0]}", f"chmod -R go= {held.folder}")
    if (held.folder / credentials.KEY).stat().st_mode & 0o077:
        return problem(name, "others can read its private key", f"chmod -R go= {held.folder}")
    keys = {path.stem for path in (held.folder / "srtp").glob("*.key")}
    payloads = {peer.partition(".")[2] for peer in held.peers}
    if lacking := sorted(payloads - keys):
        found = f"no video key of {', '.join(lacking)}"
        return problem(name, found, "copy the folder from the authority again")
    if left < _SOON:
        fix = "blimp keys rotate, and copy the folders"
        return warning(name, f"ends on {until:%Y-%m-%d}, in {left.days} days", fix)
    who = ", ".join(sorted(payloads)) or "no payload yet"
    return ok(name, f"{held.name} until {until:%Y-%m-%d}, for {who}")
