"""What the readers' targets are made of: refusals that count as answers, and shapes for bytes.

Bytes alone never get past a checksum or a length. So most targets take their input as a recipe: a
`Picker` reads choices from it, and what comes of them is right in everything but what was chosen.
It needs no fuzzer, so that every input can be played back by Python alone.
"""

from __future__ import annotations

import atexit
import base64
import contextlib
import json
import shutil
import struct
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

STRETCH = b"\xf5\xf6"
"""An input that begins so (no UTF-8 text does) is a stretched one: see `stretched`."""
STRETCH_BYTES = 1 << 20
_LONGEST_REFUSAL = 2000


@contextlib.contextmanager
def refusing(*kinds: type[Exception]) -> Iterator[None]:
    """Takes the documented errors of a reader, whose text must be one line."""
    try:
        yield
    except kinds as error:
        text = str(error)
        if len(text.splitlines()) > 1 or len(text) > _LONGEST_REFUSAL:
            raise AssertionError(f"a refusal of {len(text)} characters: {text[:200]!r}") from error


def stretched(data: bytes) -> bytes:
    """A long input from a short one: after `STRETCH`, count (u24), length (u8) and so many bytes.

    What takes quadratic time or deep recursion shows on long inputs only, and a fuzzer makes none.
    """
    if not data.startswith(STRETCH):
        return data
    picker, made = Picker(data[len(STRETCH) :]), bytearray()
    while picker.left() and len(made) < STRETCH_BYTES:
        count, piece = picker.number(3), picker.bytes(picker.number(1))
        made += piece * min(count, (STRETCH_BYTES - len(made)) // max(1, len(piece)))
    return bytes(made)


def stretch(*parts: tuple[int, bytes]) -> bytes:
    """The short form of `count` times some bytes each, at most 255 of them."""
    return STRETCH + b"".join(
        count.to_bytes(3, "little") + bytes([len(piece)]) + piece for count, piece in parts
    )


class Picker:
    """Choices from bytes, in order; zeros and nothing when they are used up."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    def left(self) -> int:
        """Bytes that were not looked at."""
        return len(self._data) - self._at

    def bytes(self, size: int) -> bytes:
        """The next bytes, at most so many."""
        piece = self._data[self._at : self._at + size]
        self._at += len(piece)
        return piece

    def rest(self) -> bytes:
        """All that is left."""
        return self.bytes(self.left())

    def number(self, size: int) -> int:
        """An unsigned number of so many bytes, little-endian."""
        return int.from_bytes(self.bytes(size), "little")

    def of(self, choices: Sequence[Any]) -> Any:
        """One of them."""
        return choices[self.number(1) % len(choices)]

    def block(self) -> bytes:
        """Bytes after their length (u16)."""
        return self.bytes(self.number(2))

    def real(self) -> float:
        """Any double, NaN and the infinities too."""
        return float(struct.unpack("<d", self.bytes(8).ljust(8, b"\0"))[0])


def blocks(*parts: bytes) -> bytes:
    """What `Picker.block` reads: each part after its length."""
    return b"".join(struct.pack("<H", len(part)) + part for part in parts)


def with_a_line(picker: Picker, whole: bytes) -> bytes:
    """A file with one of its lines exchanged for the input's rest; or that rest alone."""
    which, lines = picker.number(1), whole.splitlines(keepends=True)
    if which >= len(lines):
        return picker.rest()
    lines[which] = picker.rest() + b"\n"
    return b"".join(lines)


def under(head: bytes, data: bytes) -> bytes:
    """The input as it is; one that begins with a 0 under a head that is right."""
    return head + data[1:] if data[:1] == b"\0" else data


_BRANCHING = 8
"""How deep lists of several values nest; lists of one go as deep as a parser may."""
_ODD = (
    None, True, False, 0, 1, -1, 2**31, 2**63, -(2**63), 2**64, 10**400, 0.5, -0.0, 1e300, 1e-320,
    float("nan"), float("inf"), "", "a", "\0", "\n", "ä" * 40, "\ud800", [], {}, [[]], [{}],
    {"": None}, [0] * 300, "/", "../..", "1e999",
)  # fmt: skip


def odd(picker: Picker, depth: int = 0) -> Any:
    """A value of JSON's kinds, often one that hurts."""
    kind = picker.number(1) if depth < _BRANCHING else 0
    if kind < 2 * len(_ODD):
        return _ODD[kind % len(_ODD)]
    if kind < 150:
        return picker.number(8) - 2**62
    if kind < 180:
        return picker.real()
    if kind < 210:
        return picker.bytes(picker.number(1)).decode(errors="replace")
    if kind < 230:
        return [odd(picker, depth + 1) for _ in range(min(picker.number(1), picker.left()))]
    if kind < 250:
        names = [picker.bytes(3).decode("latin-1") for _ in range(picker.number(1) % 8)]
        return {name: odd(picker, depth + 1) for name in names}
    value: Any = []
    levels = picker.number(2) % 3000  # as deep as a parser may go, once in a value
    for _ in range(0 if depth else levels):
        value = [value]
    return value


def changed(picker: Picker, document: Mapping[str, Any]) -> dict[str, Any]:
    """A document with some of its values taken away or exchanged for odd ones."""
    made = dict(document)
    for name in document:
        choice = picker.number(1)
        if choice > 250:
            del made[name]
        elif choice > 200:
            made[name] = odd(picker)
        elif choice > 190 and isinstance(made[name], Mapping):
            made[name] = changed(picker, made[name])
    if picker.number(1) > 220:
        made[picker.bytes(4).decode("latin-1")] = odd(picker)
    return made


def as_json(document: Any) -> bytes:
    """JSON text of any document, however deep: Python's own writer gives up where readers do."""
    depth, inner = 0, document
    while isinstance(inner, list) and len(inner) == 1:
        depth, inner = depth + 1, inner[0]
    if depth > 100:
        return b"[" * depth + as_json(inner) + b"]" * depth
    if isinstance(document, dict):
        pairs = (json.dumps(name).encode() + b":" + as_json(v) for name, v in document.items())
        return b"{" + b",".join(pairs) + b"}"
    if isinstance(document, list):
        return b"[" + b",".join(map(as_json, document)) + b"]"
    if isinstance(document, bytes):  # as the bus writes it
        document = base64.b64encode(document).decode()
    return json.dumps(document).encode()


def scratch(name: str) -> Path:
    """A folder of this process for files to be read, taken away at its end."""
    folder = Path(tempfile.mkdtemp(prefix=f"fuzz-{name}-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder
