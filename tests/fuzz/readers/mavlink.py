"""`pi_firmware.autopilot.line`: MAVLink from whatever hangs on the serial line."""

from __future__ import annotations

import struct

from pieces import Picker, blocks, stretch
from pymavlink.dialects.v20 import common as mavlink

from pi_firmware.autopilot.line import SerialAutopilot
from pi_firmware.settings import AutopilotSettings
from pi_firmware.wire import messages

_KINDS = (
    mavlink.MAVLINK_MSG_ID_HEARTBEAT,
    mavlink.MAVLINK_MSG_ID_ATTITUDE,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS,
    mavlink.MAVLINK_MSG_ID_BATTERY_STATUS,
    mavlink.MAVLINK_MSG_ID_VISION_POSITION_ESTIMATE,
)


def frame(kind: int, payload: bytes, component: int = 1, flags: int = 0) -> bytes:
    """A MAVLink 2 frame with its checksum (mavlink.io, "Packet Serialization")."""
    head = struct.pack("<BBBBBB", len(payload), flags, 0, 0, 1, component)
    head += kind.to_bytes(3, "little")
    crc = mavlink.x25crc(head + payload)
    crc.accumulate(struct.pack("B", mavlink.mavlink_map[kind].crc_extra))
    return b"\xfd" + head + payload + struct.pack("<H", crc.crc)


def fuzz(data: bytes) -> None:
    """What is told of the autopilot can be sent as telemetry."""
    picker = Picker(data)
    line = SerialAutopilot(AutopilotSettings(), "none", 9600, 1, 197, lambda _: None)
    try:
        while picker.left():
            how = picker.number(1)
            if how < 200:
                kind = _KINDS[how % len(_KINDS)]
                heard = frame(kind, picker.bytes(picker.number(1)), flags=int(how == 199))
            else:
                heard = picker.block()
            line._hear(heard)
            messages.encode(line.state())
    finally:
        line._woken.close()
        line._waker.close()


def seeds() -> list[bytes]:
    """One of each kind, short and long, signed, and noise."""
    whole = [bytes([number, 40]) + bytes(range(40)) for number in range(len(_KINDS))]
    heartbeat = b"\0\x09" + bytes(4) + b"\7\3\x80\4\3"
    unknown = b"\xfd\0\0\0\0\1\1\xff\xff\xff\0\0"
    return [
        heartbeat,
        *whole,
        b"".join(whole),
        b"\0\0",
        b"\0\xff" + bytes(255),
        b"\xc7\x09" + bytes(9),
        b"\x01\x1c" + bytes(4) + struct.pack("<6f", float("nan"), *[1.0] * 5),
        b"\xff" + blocks(b"\xfe\x09\0\1\1\0" + bytes(11)),
        b"\xff" + blocks(unknown),
        stretch((1, b"\xff\xff\xff"), (65_535, b"\xfd")),
        stretch((2000, heartbeat)),
    ]
