"""`ground_station.service.intake.resuming`: a folder of recordings that a service finds."""

from __future__ import annotations

import shutil

from pieces import Picker, blocks, scratch, stretch

from ground_station.service.intake.resuming import newest_cut
from pi_firmware.wire.mcap_records import MAGIC
from readers import mcap_file

_FOLDER = scratch("resuming") / "recordings"


def fuzz(data: bytes) -> None:
    """Whatever lies there, the newest cut one is found or none is."""
    shutil.rmtree(_FOLDER, ignore_errors=True)
    _FOLDER.mkdir()
    picker = Picker(data)
    for number in range(1 + picker.number(1) % 3):
        content = mcap_file.build(picker.block())
        (_FOLDER / f"flight-{number:06d}.mcap").write_bytes(content)
    cut = newest_cut(_FOLDER)
    assert cut is None or 1 <= cut.in_a_row <= 3


def seeds() -> list[bytes]:
    """One that was cut after a whole one, and one of nothing but small records."""
    small = [seed for seed in mcap_file.seeds() if len(seed) < 1000]
    return [
        *(b"\1" + blocks(seed, seed[:-9]) for seed in small),
        b"\0" + blocks(b"\xff" + MAGIC + b"\6" + b"\xff" * 8),
        stretch((1, b"\0\xff\xff\xff" + MAGIC), (7000, b"\1" + bytes(8))),
    ]
