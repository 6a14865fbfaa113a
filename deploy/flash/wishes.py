"""What the person asked for, read from options and files and checked before a card is touched."""

from __future__ import annotations

import argparse
import dataclasses
import getpass
import os
import pwd
import stat
import sys
from pathlib import Path

from deploy.errors import DeployError, printable
from deploy.provisioning.model import OPEN, WPA2, GroundStation, Provisioning, Wifi
from deploy.provisioning.text import parse_wifi

MAX_FILE_BYTES = 64 * 1024


def read_wifi(options: argparse.Namespace) -> Wifi | None:
    """The network that the command's options name; None: none, so that it stays as it is.

    Raises `DeployError` with one line. The password is asked for on the terminal where no file
    holds it: on a command line every user of the machine could read it.
    """
    if [options.wifi_ssid is not None, options.wifi is not None, options.no_wifi].count(True) > 1:
        raise DeployError("expected one of --wifi-ssid, --wifi and --no-wifi")
    if options.wifi_ssid is None and (options.wifi_security is not None or options.wifi_hidden):
        raise DeployError("--wifi-security and --wifi-hidden go with --wifi-ssid")
    if options.wifi is not None:
        named = parse_wifi(read_file(options.wifi), options.wifi.name, options.country)
        if options.wifi_password_file is None:
            return named
        return dataclasses.replace(named, password=_password_in(options.wifi_password_file))
    if options.wifi_ssid is None:
        if options.wifi_password_file is not None:
            raise DeployError("--wifi-password-file is given without --wifi-ssid")
        return None
    if options.country is None:
        raise DeployError("--country is missing: two capital letters, as DE")
    security = options.wifi_security or WPA2
    # Checked first without the password, so that nobody types it for nothing.
    network = Wifi(
        os.fsencode(options.wifi_ssid), options.country, "", security, options.wifi_hidden
    )
    if options.wifi_password_file is not None:
        password = _password_in(options.wifi_password_file)
    elif security == OPEN:
        password = ""
    else:
        password = _ask(options.wifi_ssid)
    return dataclasses.replace(network, password=password)


def merge(
    existing: Provisioning | None,
    payload: str,
    wifi: Wifi | None,
    *,
    no_wifi: bool = False,
    ground: str | None = None,
    ssh: tuple[str, ...] | None = None,
    country: str | None = None,
) -> Provisioning:
    """What the card holds with what was asked for in its place; raises `DeployError`.

    An empty password keeps the card's own, where it is for the same network. None keeps, too.
    """
    if existing is None:
        existing = Provisioning(payload)
    old = existing.wifi
    if wifi is not None and wifi.security != OPEN and not wifi.password:
        if old is None or (old.ssid, old.security) != (wifi.ssid, wifi.security):
            raise DeployError("the Wi-Fi password is empty, and the card holds none for it")
        wifi = dataclasses.replace(wifi, password=old.password)
    if wifi is None and not no_wifi and old is not None:
        wifi = dataclasses.replace(old, country=country or old.country)
    if wifi is None and country is not None:
        raise DeployError(f"--country {country}: there is no Wi-Fi to set it for")
    return Provisioning(
        payload_id=payload,
        wifi=wifi,
        ground_station=GroundStation(ground) if ground is not None else existing.ground_station,
        authorized_keys=existing.authorized_keys if ssh is None else ssh,
    )


def read_file(path: Path) -> bytes:
    """A small regular file's bytes; raises `DeployError` with one line."""
    try:
        with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                raise DeployError(f"{path}: not a file")
            data = file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise DeployError(f"{path}: {error.strerror or error}") from None
    if len(data) > MAX_FILE_BYTES:
        raise DeployError(f"{path}: more than {MAX_FILE_BYTES} bytes")
    return data


def home() -> Path:
    """The home of the person at the keyboard, also under sudo."""
    user = os.environ.get("SUDO_USER")
    if user and os.geteuid() == 0:
        try:
            return Path(pwd.getpwnam(user).pw_dir)
        except KeyError:
            pass
    return Path.home()


def default_keys() -> Path:
    """The folder of `blimp keys`."""
    data = os.environ.get("XDG_DATA_HOME")
    return (Path(data) if data else home() / ".local/share") / "blimp/keys"


def _password_in(path: Path) -> str:
    """A file's text without the line's end that an editor puts after it."""
    data = read_file(path)
    for end in (b"\r\n", b"\n"):
        if data.endswith(end):
            data = data.removesuffix(end)
            break
    try:
        return data.decode()
    except UnicodeDecodeError:
        raise DeployError(f"{path}: not UTF-8") from None


def _ask(ssid: str) -> str:
    """Asks without echo, twice: nobody sees what they typed."""
    if not sys.stdin.isatty():
        raise DeployError("no password: give --wifi-password-file, or run it on a terminal")
    try:
        first = getpass.getpass(
            f"Password of the network '{printable(ssid)}' (empty: the card's): "
        )
        again = getpass.getpass("Once more: ") if first else ""
    except EOFError:
        raise DeployError("no password was given") from None
    if first != again:
        raise DeployError("the two passwords differ")
    return first
