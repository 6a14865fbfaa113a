"""Safetensors files from recipes: arrays of a layout, some of them other than they should be."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any

from pieces import Picker, as_json, changed, odd

_BYTES = {"F64": 8, "I64": 8, "F32": 4, "I32": 4, "U8": 1, "I8": 1}
_FORMS = {
    "F64": "d", "F32": "f", "F16": "e",
    "I64": "q", "I32": "i", "I8": "b", "U32": "I", "U16": "H", "U8": "B",
}  # fmt: skip
_TYPES = (*_BYTES, "BF16", "F16", "BOOL", "U64", "F8_E4M3")
_EXTENTS = (0, 1, 2, 2**31, 2**60, -1)

Layout = Mapping[str, tuple[str, tuple[int, ...], bytes]]
"""Type, shape and content of each array by its name."""


def build(picker: Picker, layout: Layout, metadata: Mapping[str, str]) -> bytes:
    """A file of the layout with some of it exchanged; or the bytes as they are."""
    if picker.number(1) > 250:
        return picker.rest()
    header: dict[str, Any] = {}
    told = changed(picker, metadata) if picker.number(1) > 150 else dict(metadata)
    header["__metadata__"] = told
    content = b""
    for name, (kind, shape, data) in layout.items():
        how = picker.number(1)
        if how > 250:
            continue
        if how > 240:
            kind = picker.of(_TYPES)
        if how & 3 == 3 and how > 200:
            data = (picker.block() * (len(data) + 1))[: len(data)].ljust(len(data), b"\0")
        extent = list(shape)
        if 100 < how <= 120:
            extent[picker.number(1) % len(extent)] = picker.of(_EXTENTS)
        elif 120 < how <= 130:
            extent = [picker.of(_EXTENTS) for _ in range(picker.number(1) % 5)]
        offsets: Any = [len(content), len(content) + len(data)]
        if 130 < how <= 150:
            offsets = [picker.number(2), picker.number(2)]
        entry = {"dtype": kind, "shape": extent, "data_offsets": offsets}
        header[name] = odd(picker) if 150 < how <= 155 else entry
        content += data
    text = as_json(header)
    size = picker.number(8) if picker.number(1) > 240 else len(text)
    return struct.pack("<Q", size) + text + content


def array(
    kind: str, shape: tuple[int, ...], value: float = 0
) -> tuple[str, tuple[int, ...], bytes]:
    """An entry of a layout, all of one value."""
    count = 1
    for extent in shape:
        count *= extent
    form = _FORMS[kind]
    number = float(value) if kind.startswith("F") else int(value)
    return kind, shape, struct.pack("<" + form, number) * count
