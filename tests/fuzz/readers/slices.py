"""`ground_station.stream.damage`: parameter sets, and slice headers that are renumbered."""

from __future__ import annotations

from pieces import Picker, blocks, stretch

from ground_station.stream.damage import parameter_sets, slice_header, with_frame_num
from pi_firmware.wire import annexb
from readers import h264


def fuzz(data: bytes) -> None:
    """What is read is within H.264's bounds, and a slice with its own number is the same."""
    picker = Picker(data)
    sets = parameter_sets(picker.block()) or parameter_sets(h264.access_units()[0])
    assert sets is not None and 0 < sets.width * sets.height <= 139_264
    assert 4 <= sets.frame_num_bits <= 16 and 1 <= sets.references <= 16
    unit = picker.rest()
    if not unit or (header := slice_header(unit, sets)) is None:
        return
    assert 0 <= header.first_macroblock < sets.width * sets.height
    number = header.frame_num ^ 1
    again = slice_header(with_frame_num(unit, header, sets, number), sets)
    # Bytes that no encoder wrote may hide others from who takes prevention bytes out once more.
    if again is not None and again.frame_num_at == header.frame_num_at:
        assert again.first_macroblock == header.first_macroblock


def seeds() -> list[bytes]:
    """Real ones, headers that do not end, and slices of nothing."""
    first, second = h264.access_units()
    slices = [unit for unit in annexb.nal_units(second) if annexb.nal_type(unit) == 1]
    return [
        *(blocks(first) + unit for unit in slices),
        *(blocks(first) + unit for unit in annexb.nal_units(first)),
        blocks(b"\0\0\1\x67\x64\0\x33\xac\xb4\2\0\2\0\0\0\1\x68\xee\x3c\x80") + slices[0],
        blocks(b"\0\0\1\x67" + b"\x80" * 64 + b"\0\0\1\x68\x80") + b"\x61" + b"\xff" * 9,
        stretch((1, b"\0\0\x61"), (4_000, b"\0")),
    ]
