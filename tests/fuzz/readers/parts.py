"""`hw.parts`: the budget's parts."""

from __future__ import annotations

from pieces import Picker, refusing, scratch, stretch, with_a_line

from hw.parts import load_parts
from pi_firmware.wire.errors import BlimpError

_FILE = scratch("parts") / "parts.toml"
_PART = (
    b'[[part]]\nid = "a"\nname = "a part"\nrole = "boost"\nmass_g = 5.0\nspread_g = 1.0\n'
    b'source = "measured"\ncitation = "a page"\nmanufacturer = "x"\npart_number = "1"\n'
    b"efficiency = [[3.0, 0.8], [4.2, 0.9]]\n"
)


def fuzz(data: bytes) -> None:
    """A part with a line of it exchanged, or any file."""
    _FILE.write_bytes(with_a_line(Picker(data), _PART))
    with refusing(BlimpError):
        for part in load_parts(_FILE).values():
            if part.efficiency:
                assert 0 < part.efficiency_at(3.7) <= 1


def seeds() -> list[bytes]:
    """One part, two of the same id, rows that are none."""
    return [
        b"\xff" + _PART,
        b"\xff" + _PART * 2,
        b"\x0aefficiency = [[]]",
        b"\x0aefficiency = [[1, 1, 1]]",
        b"\x0aefficiency = [1]",
        b"\1id = []",
        b"\4mass_g = inf",
        b"\1id = {a = 1}",
        stretch((1, b"\1id = [0x"), (6000, b"f"), (1, b"]")),
    ]
