"""H.264 in Annex B form: NAL units, their types, and what is put between them (ITU-T H.264)."""

from __future__ import annotations

import re
from collections.abc import Iterator

START_CODE = b"\x00\x00\x00\x01"
NAL_SLICE = 1
NAL_IDR = 5
NAL_SEI = 6
NAL_SPS = 7
NAL_PPS = 8
NAL_AUD = 9
MACROBLOCK_PX = 16

_NEEDS_PREVENTION = re.compile(rb"\x00\x00(?=[\x00-\x03])")

NO_PARAMETER_SETS = "the stream carries no parameter sets (SPS and PPS), so nothing decodes it"


def nal_units(data: bytes) -> Iterator[bytes]:
    """The NAL units of a byte stream in order, without start codes and trailing zeros.

    Empty units are skipped; bytes before the first start code belong to none.
    """
    start = data.find(b"\x00\x00\x01")
    while start >= 0:
        begin = start + 3
        start = data.find(b"\x00\x00\x01", begin)
        unit = data[begin : start if start >= 0 else len(data)].rstrip(b"\x00")
        if unit:
            yield unit


def nal_type(unit: bytes) -> int:
    """`nal_unit_type` of a NAL unit (H.264, 7.3.1)."""
    return unit[0] & 0x1F


def nal_types(data: bytes) -> list[int]:
    return [nal_type(unit) for unit in nal_units(data)]


def is_idr(data: bytes) -> bool:
    """Whether an access unit is an IDR picture, from which decoding can start.

    Its first slice tells, since all of an IDR picture are of that type (H.264, 7.4.1.2.4).
    """
    start = _first_slice(data)
    return start >= 0 and data[start + 3] & 0x1F == NAL_IDR


def insert_before_slice(access_unit: bytes, unit: bytes) -> bytes:
    """The access unit with a NAL unit (no start code) put before its first slice.

    Raises `ValueError` when it has no slice.
    """
    start = _first_slice(access_unit)
    if start < 0:
        raise ValueError("the access unit has no slice")
    if start > 0 and access_unit[start - 1] == 0:
        start -= 1
    return access_unit[:start] + START_CODE + unit + access_unit[start:]


def _first_slice(access_unit: bytes) -> int:
    """Where the three bytes of the first slice's start code are; -1 without a slice.

    A slice is most of an access unit, and nothing behind its first byte is looked at.
    """
    start = access_unit.find(b"\x00\x00\x01")
    while start >= 0 and start + 3 < len(access_unit):
        if NAL_SLICE <= access_unit[start + 3] & 0x1F <= NAL_IDR:
            return start
        start = access_unit.find(b"\x00\x00\x01", start + 3)
    return -1


def escape(rbsp: bytes) -> bytes:
    """Adds emulation prevention bytes (H.264, 7.4.1.1): 00 00 0x becomes 00 00 03 0x for x <= 3."""
    return _NEEDS_PREVENTION.sub(b"\x00\x00\x03", rbsp)


def unescape(payload: bytes) -> bytes:
    """Removes emulation prevention bytes; the inverse of `escape`."""
    return payload.replace(b"\x00\x00\x03", b"\x00\x00")
