"""`pi_firmware.wire.annexb` and `.sei`: bytes that a decoder, or a stranger, gave."""

from __future__ import annotations

from pieces import Picker, blocks, stretch

from pi_firmware.wire import annexb, sei
from readers import h264


def fuzz(data: bytes) -> None:
    """Whole as they are, or the content of one SEI unit."""
    picker = Picker(data)
    if picker.number(1) % 2:
        data = annexb.START_CODE + bytes([annexb.NAL_SEI]) + annexb.escape(picker.rest())
        assert annexb.unescape(annexb.escape(data)) == data
    else:
        data = picker.rest()
    units = list(annexb.nal_units(data))
    assert annexb.nal_types(data) == [annexb.nal_type(unit) for unit in units]
    annexb.is_idr(data)
    if (found := sei.find(data)) is not None:
        assert sei.find(annexb.START_CODE + sei.encode(found)) == found
    try:
        made = annexb.insert_before_slice(data, sei.encode(h264.info()))
    except ValueError:
        return
    assert len(made) > len(data)


def seeds() -> list[bytes]:
    """Real ones, and units that claim many messages."""
    unit = sei.encode(h264.info())
    return [
        *(b"\0" + data for data in h264.access_units()),
        b"\1" + annexb.unescape(unit[1:]),
        b"\1" + b"\xff" * 40 + b"\5" + b"\xff" * 9 + b"\3",
        stretch((1, b"\1"), (500_000, b"\4\0")),
        stretch((1, b"\1"), (100_000, b"\xff")),
        stretch((1, b"\0"), (100_000, b"\0\0\1\6")),
        stretch((1, b"\0"), (100_000, b"\0\0\1"), (1, b"\x65")),
        blocks(b"\0\0\1\5", b"\0\0\1"),
    ]
