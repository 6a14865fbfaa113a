"""What a card is told, checked where it is made: from a file or from the flasher's options."""

from __future__ import annotations

import dataclasses
import ipaddress
import re
from dataclasses import dataclass, field

from deploy.errors import DeployError
from deploy.provisioning.countries import check_country
from deploy.provisioning.ssh_keys import check_authorized_key

WPA2, WPA3, OPEN = "wpa2", "wpa3", "open"
SECURITIES = (WPA2, WPA3, OPEN)
AUTO = "auto"
VIDEO_PORT, TELEMETRY_PORT = 5600, 7447
MAX_SSID_BYTES = 32  # IEEE 802.11-2020, 9.4.2.2
MIN_PASSWORD_BYTES, MAX_PASSWORD_BYTES = 8, 63  # IEEE 802.11-2020, J.4
MAX_ENDPOINTS, MAX_KEYS = 8, 32

# The same as the firmware's rules (pi_firmware/wire/keys.py, telemetry.py); a test compares them.
_PAYLOAD_ID = re.compile(r"[a-z0-9][a-z0-9_-]{0,31}")
_ENDPOINT = re.compile(r"tls/(\[[0-9a-fA-F:]+\]|[^\[\]:/#?]+):(\d{1,5})", re.ASCII)
_PSK = re.compile(r"[0-9a-fA-F]{64}", re.ASCII)
_LABEL = re.compile(r"(?!-)[A-Za-z0-9-]{1,63}(?<!-)", re.ASCII)


@dataclass(frozen=True)
class Wifi:
    """The network to join.

    `ssid` is 1 to 32 bytes, any. `password` is the passphrase, or with WPA2 the 64 hexadecimal
    digits of the key itself; "" where the network has one means that the card keeps the one it has.
    """

    ssid: bytes
    country: str
    password: str = field(default="", repr=False)
    security: str = WPA2
    hidden: bool = False

    def __post_init__(self) -> None:
        if not 1 <= len(self.ssid) <= MAX_SSID_BYTES:
            raise DeployError(
                f"'wifi.ssid' has {len(self.ssid)} bytes; allowed: 1 to {MAX_SSID_BYTES} bytes of"
                " UTF-8"
            )
        check_country(self.country)
        if self.security not in SECURITIES:
            raise DeployError(
                f"'wifi.security' is {self.security[:20]!r}; allowed: {', '.join(SECURITIES)}"
            )
        _check_password(self.password, self.security)

    @property
    def is_psk(self) -> bool:
        """Whether the password is the key itself, as 64 hexadecimal digits."""
        return _PSK.fullmatch(self.password) is not None


@dataclass(frozen=True)
class GroundStation:
    """Whom the payload looks for: `host` "auto" (telemetry finds it) or an address."""

    host: str = AUTO
    video_port: int = VIDEO_PORT
    telemetry: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        _check_host(self.host)
        if not 1 <= self.video_port <= 65535:
            raise DeployError(
                f"'ground_station.video_port' is {_number(self.video_port)}; allowed: 1 to 65535"
            )
        if len(self.telemetry) > MAX_ENDPOINTS:
            raise DeployError(
                f"'ground_station.telemetry' has {len(self.telemetry)} entries; allowed: 0 to"
                f" {MAX_ENDPOINTS}"
            )
        for endpoint in self.telemetry:
            match = _ENDPOINT.fullmatch(endpoint)
            if match is None or not 1 <= int(match[2]) <= 65535:
                raise DeployError(
                    f"'ground_station.telemetry' has {endpoint[:60]!r}; expected tls/HOST:PORT with"
                    " a port of 1 to 65535"
                )
            _check_host(match[1].strip("[]"), "ground_station.telemetry")

    @property
    def endpoints(self) -> tuple[str, ...]:
        """Where telemetry connects: as given, or from the host; none when it is to be found."""
        if self.telemetry or self.host == AUTO:
            return self.telemetry
        host = f"[{self.host}]" if ":" in self.host else self.host
        return (f"tls/{host}:{TELEMETRY_PORT}",)


@dataclass(frozen=True)
class Provisioning:
    """All of `blimp.toml`. `wifi` is None for a payload on a cable; no key: SSH is off."""

    payload_id: str
    wifi: Wifi | None = None
    ground_station: GroundStation = field(default_factory=lambda: GroundStation())
    authorized_keys: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not _PAYLOAD_ID.fullmatch(self.payload_id):
            raise DeployError(
                f"'payload.id' is {self.payload_id[:60]!r}; allowed: 1 to 32 of a-z, 0-9, - and _,"
                " starting with a letter or digit"
            )
        if len(self.authorized_keys) > MAX_KEYS:
            raise DeployError(
                f"'ssh.authorized_keys' has {len(self.authorized_keys)} entries; allowed: 0 to"
                f" {MAX_KEYS}"
            )
        lines = tuple(
            check_authorized_key(line, f"'ssh.authorized_keys[{index}]'")
            for index, line in enumerate(self.authorized_keys)
        )
        object.__setattr__(self, "authorized_keys", lines)


def keeps_password(provisioning: Provisioning) -> bool:
    """Whether the network has a password and it is left to the one that the card holds."""
    wifi = provisioning.wifi
    return wifi is not None and wifi.security != OPEN and not wifi.password


def without_secrets(provisioning: Provisioning) -> Provisioning:
    """The same with an empty password, which means: keep the one that the card holds."""
    if provisioning.wifi is None:
        return provisioning
    return dataclasses.replace(
        provisioning, wifi=dataclasses.replace(provisioning.wifi, password="")
    )


def _check_password(password: str, security: str) -> None:
    """Errors tell the password's length and never the password."""
    if not password:
        return
    if security == OPEN:
        raise DeployError("'wifi.password' is set; with security \"open\" it must be empty")
    try:
        size = len(password.encode())
    except UnicodeEncodeError:
        raise DeployError("'wifi.password' is not valid Unicode") from None
    if "\0" in password:
        raise DeployError("'wifi.password' holds a NUL character, which no network can have")
    if security == WPA2 and _PSK.fullmatch(password):
        return
    if not MIN_PASSWORD_BYTES <= size <= MAX_PASSWORD_BYTES:
        or_key = ", or the 64 hexadecimal digits of the key" if security == WPA2 else ""
        raise DeployError(
            f"'wifi.password' has {size} bytes; allowed: {MIN_PASSWORD_BYTES} to"
            f" {MAX_PASSWORD_BYTES} bytes{or_key}"
        )


def _check_host(host: str, name: str = "ground_station.host") -> None:
    try:
        ipaddress.ip_address(host)
        return
    except ValueError:
        pass
    labels = host.split(".")
    if len(host) <= 253 and all(map(_LABEL.fullmatch, labels)) and not labels[-1].isdigit():
        return  # RFC 1123, 2.1; all digits at the end would be an address, and it is none
    raise DeployError(
        f"'{name}' is {host[:60]!r}; expected \"auto\", an IP address or a host's name"
    )


def _number(value: int) -> str:
    return str(value) if value.bit_length() <= 64 else f"a number of {value.bit_length()} bits"
