"""`blimp.toml` read and written: every key checked by name, every string escaped.

No text takes a small board's memory or hours.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Mapping
from typing import Any

from deploy.errors import DeployError
from deploy.provisioning.model import (
    AUTO,
    VIDEO_PORT,
    WPA2,
    GroundStation,
    Provisioning,
    Wifi,
    keeps_password,
)

# Python's parser takes memory with the square of a dotted key's parts. The same as the firmware's
# rule (pi_firmware/wire/config.py); a test compares them.
DEEPEST = 32
TOO_DEEP = re.compile(
    rf"""(?<![\w"'-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){{{DEEPEST}}}"""
)
_BOM = b"\xef\xbb\xbf"
# What TOML forbids, and what some editors take for the end of a line, or leave out when they save.
_ESCAPED = re.compile("[\x7f-\x9f\u2028\u2029\ufeff]")


def read(data: bytes) -> dict[str, Any]:
    """The document, with or without a byte order mark; raises `DeployError` with one line."""
    try:
        text = data.removeprefix(_BOM).decode()
        if TOO_DEEP.search(text):
            raise ValueError(f"a key has more than {DEEPEST} parts")
        return tomllib.loads(text)
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise DeployError(f"line {line} is not UTF-8; save it as UTF-8") from None
    except (ValueError, RecursionError) as error:  # a TOMLDecodeError is a ValueError, too
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        raise DeployError(f"not valid TOML: {reason}") from None


def string(text: str) -> str:
    """A TOML basic string on one line: JSON's, and a few more escapes."""
    return _ESCAPED.sub(lambda m: f"\\u{ord(m[0]):04X}", json.dumps(text, ensure_ascii=False))


FILE = "blimp.toml"
SCHEMA = 1
MAX_BYTES = 256 * 1024

_KEYS: dict[str, dict[str, type]] = {
    "payload": {"id": str},
    "wifi": {
        "ssid": str,
        "ssid_hex": str,
        "password": str,
        "country": str,
        "security": str,
        "hidden": bool,
    },
    "ground_station": {"host": str, "video_port": int, "telemetry": list},
    "ssh": {"authorized_keys": list},
}
_KIND = {str: "a text in quotes", int: "a whole number", bool: "true or false", list: "a list"}


def parse(text: bytes) -> Provisioning:
    """Reads the file's bytes; raises `DeployError` with one line that names key and range."""
    try:
        return _provisioning(_document(text))
    except DeployError as error:
        raise DeployError(f"{FILE}: {error}") from None


def parse_wifi(text: bytes, name: str, country: str | None = None) -> Wifi:
    """Reads a file that holds the table [wifi] of `blimp.toml` and nothing else.

    `name` stands in errors; `country` is used instead of the file's. Raises `DeployError`.
    """
    try:
        document = _document(text)
        if unknown := sorted(set(document) - {"wifi"}):
            raise DeployError(f"unknown key {_shown(unknown[0])} (known: wifi)")
        if "wifi" not in document:
            raise DeployError("the table [wifi] is missing")
        table = _table(document["wifi"], "wifi")
        return _wifi(table | {"country": country} if country is not None else table)
    except DeployError as error:
        raise DeployError(f"{name}: {error}") from None


def _document(text: bytes) -> dict[str, Any]:
    if len(text) > MAX_BYTES:
        raise DeployError(f"it has {len(text)} bytes; allowed: at most {MAX_BYTES}")
    if text.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise DeployError("it is UTF-16; save it as UTF-8")
    if b"\0" in text:
        raise DeployError("it holds a NUL byte: the file is cut or damaged, write it again")
    return read(text)


def _provisioning(document: dict[str, Any]) -> Provisioning:
    schema = document.pop("schema", None)
    if schema is None:
        raise DeployError(f"the key 'schema' is missing; expected schema = {SCHEMA}")
    if not isinstance(schema, int) or isinstance(schema, bool) or schema < 1:
        raise DeployError(f"'schema' is {_shown(schema)}; expected {SCHEMA}")
    if schema > SCHEMA:
        raise DeployError(
            f"'schema' is {_shown(schema)}, and this program knows {SCHEMA}: the file was made for"
            " a newer image"
        )
    if unknown := sorted(set(document) - set(_KEYS)):
        raise DeployError(f"unknown key {_shown(unknown[0])} (known: schema, {', '.join(_KEYS)})")
    tables = {name: _table(document[name], name) for name in document}
    payload = tables.get("payload", {})
    if "id" not in payload:
        raise DeployError("the key 'payload.id' is missing")
    ground = tables.get("ground_station", {})
    return Provisioning(
        payload_id=payload["id"],
        wifi=_wifi(tables["wifi"]) if "wifi" in tables else None,
        ground_station=GroundStation(
            host=ground.get("host", AUTO),
            video_port=ground.get("video_port", VIDEO_PORT),
            telemetry=_texts(ground, "ground_station", "telemetry"),
        ),
        authorized_keys=_texts(tables.get("ssh", {}), "ssh", "authorized_keys"),
    )


def _table(value: object, name: str) -> dict[str, Any]:
    known = _KEYS[name]
    if not isinstance(value, Mapping):
        raise DeployError(f"'{name}' is {_shown(value)}; expected a table, [{name}]")
    if unknown := sorted(set(value) - set(known)):
        full = _shown(f"{name}.{unknown[0]}")
        raise DeployError(f"unknown key {full} (known here: {', '.join(known)})")
    for key, item in value.items():
        kind = known[key]
        if not isinstance(item, kind) or (kind is int and isinstance(item, bool)):
            # Whatever was written for a password is not repeated on a screen or in STATUS.txt.
            shown = "of another kind" if key == "password" else _shown(item)
            raise DeployError(f"'{name}.{key}' is {shown}; expected {_KIND[kind]}")
    return dict(value)


def _wifi(table: dict[str, Any]) -> Wifi:
    if "country" not in table:
        raise DeployError("the key 'wifi.country' is missing: two capital letters, as DE")
    if ("ssid" in table) == ("ssid_hex" in table):
        raise DeployError("expected either 'wifi.ssid' or 'wifi.ssid_hex', and one of them")
    if "ssid" in table:
        ssid = table["ssid"].encode()
    else:
        try:
            ssid = bytes.fromhex(table["ssid_hex"])
        except ValueError:
            raise DeployError(
                f"'wifi.ssid_hex' is {_shown(table['ssid_hex'])}; expected 1 to 32 bytes as pairs"
                " of hexadecimal digits"
            ) from None
    return Wifi(
        ssid=ssid,
        country=table["country"],
        password=table.get("password", ""),
        security=table.get("security", WPA2),
        hidden=table.get("hidden", False),
    )


def _texts(table: dict[str, Any], name: str, key: str) -> tuple[str, ...]:
    values = table.get(key, [])
    for value in values:
        if not isinstance(value, str):
            raise DeployError(f"'{name}.{key}' holds {_shown(value)}; expected texts in quotes")
    return tuple(values)


def render(provisioning: Provisioning) -> str:
    """The file's text, which `parse` reads as the same; it holds the password in the clear."""
    ground = provisioning.ground_station
    return (
        f"""\
# What this payload is told about its world. Edit it on any computer, keep it UTF-8, and put the
# card back: it is read and checked when the payload starts, and STATUS.txt beside it tells what
# came of it. What is wrong changes nothing.
schema = {SCHEMA}

[payload]
# Its name in telemetry, and in its certificate: 1 to 32 of a-z, 0-9, - and _.
id = {string(provisioning.payload_id)}
"""
        + _wifi_text(provisioning)
        + f"""
[ground_station]
# "auto": the one that telemetry finds in this network; or its address.
host = {string(ground.host)}
# UDP port of the video, 1 to 65535.
video_port = {ground.video_port}
# Endpoints of telemetry, as ["tls/HOST:7447"]. Empty: from the host.
telemetry = {_list(ground.telemetry)}

[ssh]
# Public keys of those who may log in as pilot, one line of their .pub file each. None: no SSH.
authorized_keys = {_list(provisioning.authorized_keys)}
"""
    )


_WIFI_HELP = """
[wifi]
# The network's name, 1 to 32 bytes; or ssid_hex = "…" for a name that is no UTF-8.
{ssid}
# The password: 8 to 63 bytes, or 64 hexadecimal digits, the key itself.
{note}password = {password}
# "wpa2", "wpa3" (not every radio can), or "open".
security = {security}
# Where the radio is used: two capital letters of ISO 3166.
country = {country}
# true: the network does not announce its name.
hidden = {hidden}
"""
_NO_WIFI = """
# No Wi-Fi: the payload is on a cable. For Wi-Fi write:
# [wifi]
# ssid = "name"
# password = "8 to 63 bytes"
# country = "DE"
"""
_KEPT = """\
# Empty: the card keeps the one that it has. It is taken out of this file once it was read.
"""


def _wifi_text(provisioning: Provisioning) -> str:
    wifi = provisioning.wifi
    if wifi is None:
        return _NO_WIFI
    try:
        ssid = f"ssid = {string(wifi.ssid.decode())}"
    except UnicodeDecodeError:
        ssid = f'ssid_hex = "{wifi.ssid.hex()}"'
    return _WIFI_HELP.format(
        ssid=ssid,
        note=_KEPT if keeps_password(provisioning) else "",
        password=string(wifi.password),
        security=string(wifi.security),
        country=string(wifi.country),
        hidden="true" if wifi.hidden else "false",
    )


def _list(texts: tuple[str, ...]) -> str:
    if len(texts) < 2:
        return f"[{''.join(map(string, texts))}]"
    return "[\n" + "".join(f"    {string(text)},\n" for text in texts) + "]"


def _shown(value: object) -> str:
    if isinstance(value, int) and value.bit_length() > 64:  # Python refuses to print huge ones
        return f"a number of {value.bit_length()} bits"
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # such a number inside a list, or tables without end
        text = f"a {type(value).__name__}"
    return text if len(text) <= 60 else text[:57] + "..."
