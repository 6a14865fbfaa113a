"""Typed configuration from one commented TOML file: unknown keys and bad values refused by name."""

from __future__ import annotations

import dataclasses
import math
import re
import tomllib
import types
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from pi_firmware.wire.errors import ConfigError
from pi_firmware.wire.text import shown

T = TypeVar("T")

_MOST_BYTES = 4 << 20
# Python's parser takes memory with the square of a dotted key's parts: 100 kB of them, gigabytes.
_DEEPEST = 32
_TOO_DEEP = re.compile(
    rf"""(?<![\w"'-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){{{_DEEPEST}}}"""
)


def key(
    default: Any,
    doc: str = "",
    *,
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    choices: Sequence[Any] | None = None,
) -> Any:
    """A dataclass field that is one configuration key.

    `low` and `high` bound numbers (inclusive), `choices` lists the only values allowed. `doc` says
    what it is, where no shipped file does, and in files that are made of the dataclass.
    """
    meta = {"doc": doc, "unit": unit, "low": low, "high": high, "choices": choices}
    if isinstance(default, list | dict):
        return dataclasses.field(default_factory=lambda: type(default)(default), metadata=meta)
    return dataclasses.field(default=default, metadata=meta)


def apply_override(document: dict[str, Any], override: str, cls: type | None = None) -> None:
    """Puts `table.key=value` on top of a document that is to become a `cls`.

    A key that holds text takes what stands there as it is, any other a TOML value. Without `cls`,
    for a document that somebody else will check, what is no TOML value is text. Raises
    `ConfigError` with one line.
    """
    name, equals, text = override.partition("=")
    if not equals:
        raise ConfigError(f"--set {shown(override)}: expected key=value, as in the file")
    *tables, last = name.strip().split(".")
    for part in tables:
        document = document.setdefault(part, {})
        if not isinstance(document, dict):
            raise ConfigError(f"--set {shown(override)}: {shown(part)} is not a table")
    if cls is not None and _is_text([*tables, last], cls):
        document[last] = text
        return
    try:
        document[last] = parse(f"value = {text}")["value"]
    except (ValueError, KeyError, RecursionError):  # a TOMLDecodeError is a ValueError, too
        if cls is not None:
            what = f"--set {shown(override)}: {shown(text)}"
            raise ConfigError(f"{what} is not a TOML value") from None
        document[last] = text


def _is_text(path: list[str], kind: Any) -> bool:
    """Whether the key holds a string, which `--set` then takes as it is, without quotes."""
    for part in path:
        kind = typing.get_type_hints(kind).get(part) if dataclasses.is_dataclass(kind) else None
    return kind is str


def range_of(cls: type, name: str) -> tuple[float, float]:
    """The bounds of a number that is declared with `key`, inclusive; infinite where it has none."""
    meta = next(field.metadata for field in dataclasses.fields(cls) if field.name == name)
    low, high = meta["low"], meta["high"]
    return (-math.inf if low is None else low, math.inf if high is None else high)


def table(cls: type[T]) -> T:
    """A dataclass field that is a sub-table of the file, described by the dataclass `cls`."""
    return dataclasses.field(default_factory=cls)


def read(path: str | Path) -> dict[str, Any]:
    """Reads a TOML file as nested dictionaries; raises `ConfigError` with one line."""
    path = Path(path)
    try:
        with path.open("rb") as file:
            data = file.read(_MOST_BYTES + 1)
        if len(data) > _MOST_BYTES:
            raise ConfigError(f"{path}: more than {_MOST_BYTES} bytes, which no configuration has")
        return parse(data.decode())
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}") from None
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: not a text file, and TOML was expected") from None
    except (ValueError, RecursionError) as error:  # a TOMLDecodeError is a ValueError, too
        raise ConfigError(f"{path}: not valid TOML: {' '.join(str(error).split())}") from None


def parse(text: str) -> dict[str, Any]:
    """A TOML document of bounded size and depth; raises `ValueError` or `RecursionError`."""
    if len(text) > _MOST_BYTES:
        raise ValueError(f"more than {_MOST_BYTES} characters")
    if _TOO_DEEP.search(text):
        raise ValueError(f"a key has more than {_DEEPEST} parts")
    return tomllib.loads(text)


def load(path: str | Path, cls: type[T]) -> T:
    """Reads a TOML file into the dataclass `cls`; raises `ConfigError` with one line."""
    return from_mapping(read(path), cls, where=str(path))


def from_mapping(document: Mapping[str, Any], cls: type[T], *, where: str = "config") -> T:
    """Builds the dataclass `cls` from nested mappings, checking every key and value."""
    if not isinstance(document, Mapping):
        raise ConfigError(f"{where} must be a table")
    return _build(document, cls, where, "")


def _build(document: Mapping[str, Any], cls: type[T], where: str, prefix: str) -> T:
    fields = {field.name: field for field in dataclasses.fields(typing.cast(Any, cls))}
    hints = typing.get_type_hints(cls)
    unknown = sorted(set(document) - set(fields))
    if unknown:
        known = ", ".join(sorted(fields))
        name = shown(prefix + unknown[0])
        raise ConfigError(f"{where}: unknown key {name} (known here: {known})")
    values: dict[str, Any] = {}
    for name, field in fields.items():
        full = prefix + name
        if name not in document:
            if field.default is field.default_factory is dataclasses.MISSING:
                raise ConfigError(f"{where}: the key '{full}' is missing")
            continue
        value, kind = document[name], hints[name]
        if dataclasses.is_dataclass(kind):
            if not isinstance(value, Mapping):
                raise ConfigError(f"{where}: '{full}' must be a table")
            values[name] = _build(value, typing.cast(type, kind), where, full + ".")
        else:
            values[name] = _check(value, kind, field.metadata, f"{where}: '{full}'")
    try:
        return cls(**values)
    except ValueError as error:  # a dataclass's own cross-check in __post_init__
        raise ConfigError(f"{where}: {error}") from None


def _check(value: Any, kind: Any, meta: Mapping[str, Any], what: str) -> Any:
    origin = typing.get_origin(kind)
    if origin in (types.UnionType, typing.Union):
        kinds = [k for k in typing.get_args(kind) if k is not type(None)]
        kind = kinds[0]
        origin = typing.get_origin(kind)
    if origin is list or kind is list:
        if not isinstance(value, list):
            raise ConfigError(f"{what} must be a list, not {shown(value)}")
        (item,) = typing.get_args(kind) or (Any,)
        return [_check(v, item, meta, f"{what}[{i}]") for i, v in enumerate(value)]
    kind = origin or kind  # a dict is one, whatever it holds
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        try:
            value = float(value)
        except OverflowError:
            raise ConfigError(f"{what} must be a finite number, not {shown(value)}") from None
    if kind is not Any and (
        not isinstance(value, kind) or (kind is int and isinstance(value, bool))
    ):
        raise ConfigError(f"{what} must be {_kind_name(kind)}, not {shown(value)}")
    if isinstance(value, float) and not math.isfinite(value):
        raise ConfigError(f"{what} must be a finite number, not {value!r}")
    choices = meta.get("choices")
    if choices is not None and value not in choices:
        allowed = ", ".join(map(repr, choices))
        raise ConfigError(f"{what} is {shown(value)}; allowed: {allowed}")
    low, high, unit = meta.get("low"), meta.get("high"), meta.get("unit", "")
    if isinstance(value, int | float) and not isinstance(value, bool):
        too_low, too_high = low is not None and value < low, high is not None and value > high
        if too_low or too_high:
            span = f"{'-inf' if low is None else low} to {'inf' if high is None else high}"
            raise ConfigError(
                f"{what} is {shown(value)}; allowed: {span}{' ' + unit if unit else ''}"
            )
    return value


def _kind_name(kind: Any) -> str:
    names = {float: "a number", int: "a whole number", str: "a string", bool: "true or false"}
    return names.get(kind, str(kind))
