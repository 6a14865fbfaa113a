"""TOML from the boot partition, read so that no text takes a small board's memory or hours."""

from __future__ import annotations

import re
import tomllib
from typing import Any

# Python's parser takes memory with the square of a dotted key's parts. The same as the firmware's
# rule (pi_firmware/wire/config.py); a test compares them.
DEEPEST = 32
TOO_DEEP = re.compile(
    rf"""(?<![\w"'-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){{{DEEPEST}}}"""
)
_BOM = b"\xef\xbb\xbf"


def read(data: bytes) -> dict[str, Any]:
    """The document, with or without a byte order mark before it.

    Raises `UnicodeDecodeError`, `ValueError` or `RecursionError`.
    """
    text = data.removeprefix(_BOM).decode()
    if TOO_DEEP.search(text):
        raise ValueError(f"a key has more than {DEEPEST} parts")
    return tomllib.loads(text)
