"""The firmware's payload.toml out of four: later ones win, key by key.

the firmware's defaults < the board's < blimp/payload.toml < what blimp.toml says
"""

from __future__ import annotations

import copy
import math
import re
from collections.abc import Mapping
from typing import Any

from deploy.errors import DeployError
from deploy.provisioning import text as toml
from deploy.provisioning.model import Provisioning

_BARE = re.compile(r"[A-Za-z0-9_-]+", re.ASCII)
CABLE, RADIO = "eth0", "wlan0"


def read(data: bytes, name: str) -> dict[str, Any]:
    """A TOML file's document; raises `DeployError` that begins with `name`."""
    try:
        return toml.read(data)
    except DeployError as error:
        raise DeployError(f"{name}: {error}") from None


def merged(
    board: Mapping[str, Any],
    user: Mapping[str, Any],
    provisioning: Provisioning,
    certificates: str,
) -> dict[str, Any]:
    """The document of this payload's payload.toml; `certificates` is the folder on the card.

    Raises `DeployError` when the user's `link` or `telemetry` is no table. All else is checked by
    the firmware, which alone knows its keys.
    """
    document = _over(board, user)
    link, telemetry = (_table(document, name) for name in ("link", "telemetry"))
    station = provisioning.ground_station
    document["payload_id"] = provisioning.payload_id
    link["host"], link["port"] = station.host, station.video_port
    telemetry["connect"] = list(station.endpoints)
    telemetry["certificates"] = certificates
    if station.host == "auto":
        telemetry.setdefault("discover", RADIO if provisioning.wifi else CABLE)
    return document


def dump(document: Mapping[str, Any]) -> str:
    """TOML text that reads as the same document; raises `DeployError` for dates and times."""
    return "".join(_lines(document, ()))


def _over(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    result = copy.deepcopy(dict(below))
    for key, value in above.items():
        mine = result.get(key)
        if isinstance(value, Mapping):
            value = _over(mine if isinstance(mine, Mapping) else {}, value)
        result[key] = value
    return result


def _table(document: dict[str, Any], name: str) -> dict[str, Any]:
    table = document.setdefault(name, {})
    if not isinstance(table, dict):
        raise DeployError(f"payload.toml: '{name}' must be a table")
    return table


def _lines(table: Mapping[str, Any], path: tuple[str, ...]) -> list[str]:
    lines = []
    for key, value in table.items():
        if not isinstance(value, Mapping):
            lines.append(f"{_key(key)} = {_value(value, '.'.join((*path, key)))}\n")
    for key, value in table.items():
        if isinstance(value, Mapping):
            inside = (*path, key)
            lines.append(f"\n[{'.'.join(map(_key, inside))}]\n")
            lines += _lines(value, inside)
    return lines


def _key(key: str) -> str:
    return key if _BARE.fullmatch(key) else toml.string(key)


def _value(value: Any, name: str) -> str:
    if isinstance(value, str):
        return toml.string(value)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        if value.bit_length() > 64:  # Python refuses to print huge ones
            raise DeployError(f"payload.toml: '{name}' is a number of {value.bit_length()} bits")
        return str(value)
    if isinstance(value, float):
        return repr(value) if math.isfinite(value) else str(value)
    if isinstance(value, list):
        return f"[{', '.join(_value(item, name) for item in value)}]"
    if isinstance(value, Mapping):
        items = (f"{_key(key)} = {_value(item, name)}" for key, item in value.items())
        return f"{{{', '.join(items)}}}"
    raise DeployError(f"payload.toml: '{name}' is a {type(value).__name__}, which no key takes")
