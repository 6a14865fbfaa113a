"""The frame's own numbers inside its H.264 access unit, as SEI `user_data_unregistered`.

Layout (H.264, D.1.7): 16 bytes UUID, then in network byte order

    offset  type  field
    0       u8    version, 1 now; a later one may only append
    1       u8    flags: bit 0 heartbeat (the gate would have dropped this frame)
    2       u16   reserved, 0
    4       u32   sequence: captured frames counted from 0, gated ones included
    8       i64   time_ns: capture time of the camera, the middle of the middle row's exposure; a
                  recording's own in a replay
    16      i64   clock_ns: the payload's clock at that capture, to measure latency with
    24      f32   entropy_bits: Shannon entropy of the luma
    28      f32   sharpness: mean squared gradient of the luma, grey levels squared
    32      f32   exposure_s, NaN where the camera does not tell
    36      f32   gain, NaN where the camera does not tell

For a live camera `time_ns` and `clock_ns` are the same number. A reader takes the fields it knows
and skips what a later version appended.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass

from pi_firmware.wire import annexb

UUID = bytes.fromhex("6f0fd9ec2c0b4c1b9d864f2a5d6b1e07")
VERSION = 1
_BODY = struct.Struct(">BBHIqqffff")
_USER_DATA_UNREGISTERED = 5
_FLAG_HEARTBEAT = 1


@dataclass(frozen=True)
class FrameInfo:
    """What travels with a frame; `exposure_s` and `gain` are None where the camera is silent."""

    sequence: int
    time_ns: int
    clock_ns: int
    entropy_bits: float
    sharpness: float
    exposure_s: float | None = None
    gain: float | None = None
    heartbeat: bool = False


def encode(info: FrameInfo) -> bytes:
    """The SEI NAL unit (no start code, emulation prevention applied)."""
    body = _BODY.pack(
        VERSION,
        _FLAG_HEARTBEAT if info.heartbeat else 0,
        0,
        info.sequence & 0xFFFFFFFF,
        info.time_ns,
        info.clock_ns,
        info.entropy_bits,
        info.sharpness,
        math.nan if info.exposure_s is None else info.exposure_s,
        math.nan if info.gain is None else info.gain,
    )
    payload = UUID + body
    rbsp = bytes([_USER_DATA_UNREGISTERED, len(payload)]) + payload + b"\x80"
    return bytes([annexb.NAL_SEI]) + annexb.escape(rbsp)


def find(access_unit: bytes) -> FrameInfo | None:
    """The frame's numbers from an access unit in Annex B form; None when it carries none.

    Damaged or foreign bytes give None, never an exception.
    """
    for unit in annexb.nal_units(access_unit):
        if annexb.nal_type(unit) == annexb.NAL_SEI:
            for kind, payload in _messages(annexb.unescape(unit[1:])):
                if kind == _USER_DATA_UNREGISTERED and payload.startswith(UUID):
                    return _decode(payload[len(UUID) :])
    return None


def _messages(rbsp: bytes) -> Iterator[tuple[int, bytes]]:
    """The SEI messages of a unit (H.264, 7.3.2.3.1), up to the first that does not fit."""
    at = 0
    while at + 2 <= len(rbsp):  # the trailing bits are one byte
        values = []
        for _ in range(2):  # payload type, then size: 255s add up until a smaller byte
            value = 0
            while at < len(rbsp) and rbsp[at] == 0xFF:
                value += 255
                at += 1
            if at >= len(rbsp):
                return
            values.append(value + rbsp[at])
            at += 1
        kind, size = values
        if at + size > len(rbsp):
            return
        yield kind, rbsp[at : at + size]
        at += size


def _decode(body: bytes) -> FrameInfo | None:
    if len(body) < _BODY.size:
        return None
    version, flags, _, sequence, time_ns, clock_ns, entropy, sharpness, exposure, gain = (
        _BODY.unpack_from(body)
    )
    if version < VERSION or not (math.isfinite(entropy) and math.isfinite(sharpness)):
        return None
    return FrameInfo(
        sequence=sequence,
        time_ns=time_ns,
        clock_ns=clock_ns,
        entropy_bits=entropy,
        sharpness=sharpness,
        exposure_s=exposure if math.isfinite(exposure) else None,
        gain=gain if math.isfinite(gain) else None,
        heartbeat=bool(flags & _FLAG_HEARTBEAT),
    )
