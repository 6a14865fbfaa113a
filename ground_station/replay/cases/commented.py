"""A configuration as commented TOML: every key with what it is, its unit, range and default."""

from __future__ import annotations

import dataclasses
import textwrap
from collections.abc import Collection, Mapping
from typing import Any

import tomli_w

_LINES = textwrap.TextWrapper(98, break_long_words=False, break_on_hyphens=False)
_FEW = 6
"""More choices than this stand in a comment nowhere: the key's description says what they are."""


def commented(
    values: Any, *, remarks: Mapping[str, str] | None = None, brief: Collection[str] = ()
) -> str:
    """A dataclass of `wire.config` keys as TOML text that reads back as the same.

    Keys that are None stand in comments, without a value; in the tables named in `brief` they are
    left out. `remarks` are further comments, by the dotted name of a key or table.
    """
    lines: list[str] = []
    _table(values, "", remarks or {}, brief, lines)
    return "\n".join(lines).strip() + "\n"


def _table(
    values: Any, name: str, remarks: Mapping[str, str], brief: Collection[str], lines: list[str]
) -> None:
    plain: list[tuple[dataclasses.Field[Any], Any]] = []
    tables: list[tuple[dataclasses.Field[Any], Any]] = []
    for item in dataclasses.fields(values):
        value = getattr(values, item.name)
        (tables if dataclasses.is_dataclass(value) else plain).append((item, value))
    if name and plain:
        lines += ["", f"[{name}]"]
    lines += _remark(remarks, name)
    prefix = f"{name}." if name else ""
    for item, value in plain:
        if name in brief and (value is None or value is False):
            continue
        lines += [f"# {line}" for line in _LINES.wrap(_about(item))]
        lines += _remark(remarks, prefix + item.name)
        lines.append(f"# {item.name} =" if value is None else f"{item.name} = {toml(value)}")
    for item, value in tables:
        _table(value, prefix + item.name, remarks, brief, lines)


def toml(value: Any) -> str:
    """A plain value or a list of them as TOML, on one line."""
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    return tomli_w.dumps({"x": value}).strip().partition(" = ")[2]


def _remark(remarks: Mapping[str, str], name: str) -> list[str]:
    return [f"# {line}" for line in remarks.get(name, "").splitlines()]


def _about(item: dataclasses.Field[Any]) -> str:
    """Description, unit, range and default in one sentence."""
    meta = item.metadata
    choices, low, high = meta.get("choices"), meta.get("low"), meta.get("high")
    told = [meta["unit"]] if meta.get("unit") else []
    if choices is not None and len(choices) <= _FEW:
        told.append(" | ".join(map(toml, choices)))
    if low is not None and high is not None:
        told.append(f"{_short(low)} to {_short(high)}")
    elif low is not None:
        told.append(f"{_short(low)} or more")
    missing = dataclasses.MISSING
    default = item.default if item.default_factory is missing else item.default_factory()
    if default is None:
        told.append("not set by default")
    elif default is not missing:
        told.append(f"default {toml(default)}")
    return str(meta["doc"]) + (f" ({', '.join(told)})" if told else "")


def _short(value: float) -> str:
    return str(int(value)) if value == int(value) else repr(value)
