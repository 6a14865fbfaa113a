"""`--lan`: all that a station needs to be found and heard on a network, set together.

That is its certificates, the TLS listener, the video's address and discovery. A payload whose card
`make flash` wrote needs nothing more: it looks for its station on the network that it joins.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import os
import pwd
import socket
import struct
from collections.abc import Sequence
from pathlib import Path

from ground_station import user_folders
from ground_station.errors import InputError
from ground_station.service.settings import FLEET_PORT, StationSettings
from pi_firmware.wire import credentials, scouting
from pi_firmware.wire.errors import TelemetryError
from pi_firmware.wire.telemetry import PORT, check_endpoint

CARD_NOTE = "flashed.json"
"""Beside a payload's keys: which stations its card was told of. deploy/flash/keys.py writes it."""
EVERYWHERE = "0.0.0.0"  # addresses come and go; who may speak is for the certificates to decide
_SIOCGIFFLAGS = 0x8913  # Linux, not in Python's modules
_WANTED, _UNWANTED = 0x1 | 0x40 | 0x1000, 0x8 | 0x10
"""netdevice(7): up, running and with multicast; neither loopback nor a tunnel."""


def interfaces() -> dict[str, str]:
    """The interfaces on which payloads can find this station, with their IPv4 addresses."""
    found = {}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        for _, name in socket.if_nameindex():
            try:
                reply = fcntl.ioctl(any_socket, _SIOCGIFFLAGS, struct.pack("256s", name.encode()))
            except OSError:  # gone meanwhile
                continue
            (flags,) = struct.unpack_from("H", reply, 16)
            address = scouting.interface_address(name)
            if address and flags & _WANTED == _WANTED and not flags & _UNWANTED:
                found[name] = address
    return found


def on(settings: StationSettings, interface: str = "") -> StationSettings:
    """The settings of a station on the network of an interface; "": the only one there is.

    Certificates that are configured stay, otherwise they are those of `blimp keys ground NAME`.
    Raises `InputError` with one line when there are none, or when the interface must be named.
    """
    held = _certificates(settings)
    found = interfaces()
    if not interface:
        if len(found) != 1:
            named = ", ".join(f"{name} ({address})" for name, address in found.items())
            raise InputError(
                f"--lan: which network are the payloads in? name one of {named}"
                if found
                else "--lan: no interface of this machine is up and has an address"
            )
        (interface,) = found
    elif interface not in found:
        named = ", ".join(found) or "none"
        raise InputError(f"--lan {interface}: not up, without an address, or not there ({named})")
    telemetry = settings.telemetry
    port = PORT
    if telemetry.listen:
        certified = bool(telemetry.certificates)
        _, port = check_endpoint(telemetry.listen[0], certified=certified)
    fleet = settings.fleet
    if held.stations and not fleet.listen:  # who is alone has nobody to join it
        fleet = dataclasses.replace(fleet, listen=[f"tls/{EVERYWHERE}:{FLEET_PORT}"])
    return dataclasses.replace(
        settings,
        fleet=fleet,
        video=dataclasses.replace(settings.video, host=EVERYWHERE),
        telemetry=dataclasses.replace(
            telemetry,
            listen=[f"tls/{EVERYWHERE}:{port}"],
            certificates=str(held.folder),
            discoverable=interface,
        ),
    )


def joined(settings: StationSettings, stations: Sequence[str]) -> StationSettings:
    """The settings of a station that joins others, given by HOST or HOST:PORT.

    Raises `InputError` with one line for what is no address, or without certificates.
    """
    if not settings.telemetry.certificates:
        raise InputError("--join: stations know each other by certificates; add --lan")
    join = list(settings.fleet.join)
    for station in stations:
        host, colon, port = station.rpartition(":")
        endpoint = (
            f"tls/{host}:{port}" if colon and port.isdigit() else f"tls/{station}:{FLEET_PORT}"
        )
        try:
            check_endpoint(endpoint, certified=True)
        except TelemetryError:
            raise InputError(f"--join {station!r:.60}: expected HOST or HOST:PORT") from None
        join.append(endpoint)
    return dataclasses.replace(settings, fleet=dataclasses.replace(settings.fleet, join=join))


def announced(settings: StationSettings, interface: str) -> StationSettings:
    """The settings that `on` makes, told to who started the command."""
    heard = on(settings, interface)
    print(summary(heard), flush=True)
    return heard


def summary(settings: StationSettings) -> str:
    """What a person must know of it, in lines: where it listens, and what a payload needs."""
    telemetry = settings.telemetry
    held = credentials.load(telemetry.certificates)
    address = scouting.interface_address(telemetry.discoverable)
    _, port = check_endpoint(telemetry.listen[0], certified=True)
    payloads = [peer.partition(".")[2] for peer in held.peers]
    name = payloads[0] if len(payloads) == 1 else "NAME"
    side = [station.partition(".")[2] for station in held.stations]
    return "\n".join(
        (
            f"station '{held.member}' on {telemetry.discoverable}, {address}: telemetry tcp {port}"
            f" (TLS), video udp {settings.video.port} (SRTP), discovery udp 7446",
            f"hears the payloads: {', '.join(payloads)}"
            if payloads
            else "hears nobody yet: blimp keys payload NAME, then start this again",
            f"a payload's card: make flash DEVICE=/dev/sdX IMAGE=FILE PAYLOAD={name} WIFI=SSID"
            " COUNTRY=DE",
            *([f"joined by {', '.join(side)}: blimp serve --lan --join {address}"] if side else []),
            "it finds this station by itself on the same network, or by"
            f" OPTIONS='--ground {address}' where multicast does not pass",
            f"nothing comes? blimp doctor --lan {telemetry.discoverable}"
            " (with sudo it sees the firewall, too)",
        )
    )


def authority() -> Path:
    """Where `blimp keys` made the keys: of the person at the keyboard, also under sudo."""
    if os.geteuid() == 0 and (person := os.environ.get("SUDO_USER")):
        with contextlib.suppress(KeyError):
            theirs = Path(pwd.getpwnam(person).pw_dir) / ".local/share/blimp/keys"
            if theirs.is_dir():
                return theirs
    return user_folders.data() / "keys"


def _certificates(settings: StationSettings) -> credentials.Credentials:
    """This station's; raises `InputError` that names the command which makes them."""
    keys = authority()
    stations = keys / credentials.GROUND
    folder = Path(settings.telemetry.certificates or stations / settings.name)
    if not folder.is_dir():
        make = f"blimp keys ground {settings.name}"
        if not keys.is_dir():
            make = f"blimp keys init && {make} && blimp keys payload blimp-1"
        others = sorted(path.name for path in stations.glob("*") if path.is_dir())
        hint = f" (keys are here of: {', '.join(others)}; --set name=NAME)" if others else ""
        raise InputError(f"--lan: no certificates in {folder}; make them: {make}{hint}")
    try:
        held = credentials.load(folder)
    except TelemetryError as error:
        raise InputError(f"--lan: {error}") from None
    expected = f"{credentials.GROUND}.{settings.name}"
    if held.name != expected:
        raise InputError(
            f"--lan: {folder} is of {held.name}, and this station is {expected};"
            f" set its name: --set name={held.member}"
        )
    return held
