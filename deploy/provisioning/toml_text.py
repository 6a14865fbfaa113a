"""TOML as the card reads and writes it: no text takes a small board's memory or hours."""

from __future__ import annotations

import re
import tomllib
from typing import Any

from deploy.errors import DeployError

# Python's parser takes memory with the square of a dotted key's parts. The same as the firmware's
# rule (pi_firmware/wire/config.py); a test compares them.
DEEPEST = 32
TOO_DEEP = re.compile(
    rf"""(?<![\w"'-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){{{DEEPEST}}}"""
)
_BOM = b"\xef\xbb\xbf"
_SHORT = {'"': '\\"', "\\": "\\\\", "\n": "\\n", "\r": "\\r", "\t": "\\t"}
# What some editors take for the end of a line, or leave out when they save.
_ESCAPED = {0x7F, *range(0x80, 0xA0), 0x2028, 0x2029, 0xFEFF}


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
    """A TOML basic string on one line."""
    characters = []
    for character in text:
        code = ord(character)
        if character in _SHORT:
            characters.append(_SHORT[character])
        elif code < 0x20 or code in _ESCAPED:
            characters.append(f"\\u{code:04X}")
        else:
            characters.append(character)
    return f'"{"".join(characters)}"'
