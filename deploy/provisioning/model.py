"""What a card is told, checked where it is made: from a file or from the flasher's options."""

from __future__ import annotations

import base64
import binascii
import dataclasses
import ipaddress
import re
from dataclasses import dataclass, field

from deploy.errors import DeployError

TYPES = (
    "ssh-ed25519",
    "ecdsa-sha2-nistp256",
    "ecdsa-sha2-nistp384",
    "ecdsa-sha2-nistp521",
    "ssh-rsa",
    "sk-ssh-ed25519@openssh.com",
    "sk-ecdsa-sha2-nistp256@openssh.com",
)
MAX_BYTES = 8192
# sshd's own least size; shorter ones it refuses at log-in, which nobody would understand.
MIN_RSA_BITS = 2048
_UNPRINTABLE = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]")


def check_authorized_key(line: str, what: str) -> str:
    """Returns the line without blanks around it; raises `DeployError` when it is no public key.

    The key's bytes must begin with its type (RFC 4253, 6.6), so a line cut while it was copied is
    found here and not when the card is out of reach. `what` names the line in the error.
    """
    text = line.strip()
    if "PRIVATE KEY" in text:
        raise DeployError(f"{what} is a private key; give the public one, the file with .pub")
    if _UNPRINTABLE.search(text) or len(text.encode()) > MAX_BYTES:
        raise DeployError(f"{what}: expected one line of at most {MAX_BYTES} bytes")
    kind, _, rest = text.partition(" ")
    if kind not in TYPES:
        raise DeployError(
            f"{what} starts with {kind[:30]!r}; expected 'TYPE KEY NAME' without options, TYPE one"
            f" of {', '.join(TYPES)}"
        )
    try:
        blob = base64.b64decode(rest.split(" ")[0], validate=True)
        parts = _strings(blob)
    except (binascii.Error, ValueError):
        parts = []
    if len(parts) < 2 or parts[0] != kind.encode():
        raise DeployError(f"{what}: the key after {kind} is cut or damaged")
    if kind == "ssh-rsa":
        bits = int.from_bytes(parts[-1], "big").bit_length()
        if bits < MIN_RSA_BITS:
            raise DeployError(f"{what} is an RSA key of {bits} bits; allowed: {MIN_RSA_BITS} on")
    return text


def _strings(blob: bytes) -> list[bytes]:
    """SSH's strings in a row, each after its length; raises `ValueError` when they don't fit."""
    parts = []
    while blob:
        length = int.from_bytes(blob[:4], "big")
        if len(blob) < 4 + length:
            raise ValueError("cut")
        parts.append(blob[4 : 4 + length])
        blob = blob[4 + length :]
    return parts


# ISO 3166-1 alpha-2, as the kernel's rules for radios name them. A code that the kernel does not
# know leaves the radio on the world's common denominator without a word: the network on channel 13
# is then never found. So a code that does not exist is refused.
_COUNTRIES = """
    AD AE AF AG AI AL AM AO AQ AR AS AT AU AW AX AZ BA BB BD BE BF BG BH BI BJ BL BM BN BO BQ BR BS
    BT BV BW BY BZ CA CC CD CF CG CH CI CK CL CM CN CO CR CU CV CW CX CY CZ DE DJ DK DM DO DZ EC EE
    EG EH ER ES ET FI FJ FK FM FO FR GA GB GD GE GF GG GH GI GL GM GN GP GQ GR GS GT GU GW GY HK HM
    HN HR HT HU ID IE IL IM IN IO IQ IR IS IT JE JM JO JP KE KG KH KI KM KN KP KR KW KY KZ LA LB LC
    LI LK LR LS LT LU LV LY MA MC MD ME MF MG MH MK ML MM MN MO MP MQ MR MS MT MU MV MW MX MY MZ NA
    NC NE NF NG NI NL NO NP NR NU NZ OM PA PE PF PG PH PK PL PM PN PR PS PT PW PY QA RE RO RS RU RW
    SA SB SC SD SE SG SH SI SJ SK SL SM SN SO SR SS ST SV SX SY SZ TC TD TF TG TH TJ TK TL TM TN TO
    TR TT TV TW TZ UA UG UM US UY UZ VA VC VE VG VI VN VU WF WS YE YT ZA ZM ZW
"""
CODES = frozenset(_COUNTRIES.split())
_OFTEN_MEANT = {"UK": "GB", "EN": "GB", "EL": "GR"}


def check_country(code: str) -> str:
    """Returns the code; raises `DeployError` when it is no country's."""
    if code in CODES:
        return code
    capitals = code.upper()
    meant = capitals if capitals in CODES else _OFTEN_MEANT.get(capitals)
    hint = f" (is it {meant}?)" if meant else ""
    raise DeployError(
        f"'wifi.country' is {code[:20]!r}; expected the two capital letters of ISO 3166, as DE or"
        f" US{hint}"
    )


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
