"""Device URIs, `scheme:path?option=value&…`: one string in the config chooses a device."""

from __future__ import annotations

import math
from dataclasses import dataclass
from urllib.parse import parse_qsl

from pi_firmware.wire.errors import SourceError
from pi_firmware.wire.text import shown


@dataclass(frozen=True)
class Uri:
    """A parsed device URI; `what` is the config key that holds it, for error lines."""

    text: str
    what: str
    scheme: str
    path: str
    options: dict[str, str]

    def fail(self, reason: str) -> SourceError:
        """The error to raise about this URI."""
        return SourceError(f"{self.what} {shown(self.text, 200)}: {reason}")

    def only(self, *names: str) -> None:
        """Raises `SourceError` for an option that the device does not have."""
        for name in self.options:
            if name not in names:
                known = ", ".join(names) or "none"
                raise self.fail(f"unknown option {shown(name, 200)} (known: {known})")

    def number(self, name: str, default: float, low: float, high: float) -> float:
        """A numeric option within its range."""
        text = self.options.get(name)
        if text is None:
            return default
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            raise self.fail(f"{name} is {shown(text, 200)}; allowed: {low:g} to {high:g}")
        return value

    def choice(self, name: str, default: str, allowed: tuple[str, ...]) -> str:
        """An option with a fixed set of values."""
        value = self.options.get(name, default)
        if value not in allowed:
            raise self.fail(f"{name} is {shown(value, 200)}; allowed: {', '.join(allowed)}")
        return value


def parse(text: str, what: str) -> Uri:
    """Splits a device URI; raises `SourceError` with one line."""
    scheme, colon, rest = text.partition(":")
    if not colon or not scheme:
        raise SourceError(f"{what} {shown(text, 200)}: expected scheme:path?option=value")
    path, _, query = rest.partition("?")
    parsed = Uri(text, what, scheme, path, {})
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=bool(query))
    except ValueError:
        raise parsed.fail("the options are not name=value&…") from None
    for name, value in pairs:
        if name in parsed.options:
            raise parsed.fail(f"option {shown(name, 200)} is given twice")
        parsed.options[name] = value
    return parsed
