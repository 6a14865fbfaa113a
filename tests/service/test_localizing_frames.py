"""Frames are taken only when they are what they say."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ground_station.service import bus_messages
from ground_station.service.bus_messages import FrameMessage
from ground_station.service.localizing.frames import GONE, Taken, fault_of, take
from ground_station.service.localizing.rate_limited_log import RateLimitedLog
from ground_station.service.pictures import SLOTS, PictureReader, PictureWriter

IMAGE = np.arange(48 * 64, dtype=np.uint8).reshape(48, 64)
FIELDS: dict[str, Any] = {
    "slot": 0, "stamp": 2, "sequence": 1, "time_ns": 10, "clock_ns": 20, "arrival_ns": 30,
    "width_px": 64, "height_px": 48, "ssrc": 5,
}  # fmt: skip


@pytest.fixture
def ring(tmp_path: Path) -> tuple[PictureWriter, PictureReader]:
    return PictureWriter(tmp_path, "blimp-1"), PictureReader(tmp_path, "blimp-1")


def test_a_frame_is_taken_with_its_picture(ring: tuple[PictureWriter, PictureReader]) -> None:
    writer, reader = ring
    slot, stamp = writer.write(IMAGE)
    note = FrameMessage(**FIELDS | {"slot": slot, "stamp": stamp, "exposure_s": 0.01})
    taken = take(reader, note)
    assert isinstance(taken, Taken)
    assert (taken.image == IMAGE).all() and taken.exposure_s == 0.01 and taken.note is note


def test_a_picture_that_was_overwritten_is_gone(ring: tuple[PictureWriter, PictureReader]) -> None:
    writer, reader = ring
    slot, stamp = writer.write(IMAGE)
    for _ in range(SLOTS):
        writer.write(IMAGE)
    assert take(reader, FrameMessage(**FIELDS | {"slot": slot, "stamp": stamp})) is GONE


def test_without_a_ring_a_picture_is_gone(tmp_path: Path) -> None:
    assert take(PictureReader(tmp_path, "blimp-1"), FrameMessage(**FIELDS)) is GONE


@pytest.mark.parametrize("slot", [SLOTS, 99, 1 << 40])
def test_a_slot_out_of_range_is_gone(slot: int, ring: tuple[PictureWriter, PictureReader]) -> None:
    writer, reader = ring
    writer.write(IMAGE)
    assert take(reader, FrameMessage(**FIELDS | {"slot": slot})) is GONE


def test_a_picture_of_another_size_is_refused(ring: tuple[PictureWriter, PictureReader]) -> None:
    writer, reader = ring
    slot, stamp = writer.write(IMAGE)
    note = FrameMessage(**FIELDS | {"slot": slot, "stamp": stamp, "width_px": 640})
    assert take(reader, note) == "its picture has 64x48 px, not 640x48"


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("slot", -1), ("slot", "0"), ("slot", 0.0), ("slot", True), ("stamp", None),
        ("time_ns", float("nan")), ("time_ns", 1 << 63), ("time_ns", [1]), ("clock_ns", -5),
        ("sequence", {}), ("width_px", 1 << 70), ("height_px", "480"), ("ssrc", None),
        ("capture_ns", "now"), ("capture_ns", 1 << 63),
    ],
)  # fmt: skip
def test_values_that_cannot_be_are_named(name: str, value: Any) -> None:
    assert fault_of(FrameMessage(**FIELDS)) == ""
    assert fault_of(FrameMessage(**FIELDS | {name: value})).startswith(f"{name} is ")


def test_nan_on_the_bus_is_refused_and_not_believed() -> None:
    """JSON's parser takes NaN, though JSON has none."""
    note = bus_messages.decode(
        FrameMessage, json.dumps(FIELDS | {"time_ns": float("nan")}).encode()
    )
    assert fault_of(note)


@pytest.mark.parametrize("exposure", [float("nan"), -1.0, 1e9, "0.01", None, True])
def test_an_exposure_that_cannot_be_is_not_known(
    exposure: Any, ring: tuple[PictureWriter, PictureReader]
) -> None:
    writer, reader = ring
    _, stamp = writer.write(IMAGE)
    taken = take(reader, FrameMessage(**FIELDS | {"stamp": stamp, "exposure_s": exposure}))
    assert isinstance(taken, Taken) and taken.exposure_s is None


def test_what_repeats_is_said_once_a_minute_with_its_count() -> None:
    said: list[tuple[str, str]] = []
    now_s = [100.0]
    seldom = RateLimitedLog(lambda name, text: said.append((name, text)), clock=lambda: now_s[0])
    assert seldom("a", "first") and not seldom("a", "second") and seldom("b", "other")
    now_s[0] += 59.0
    assert not seldom("a", "third")
    now_s[0] += 2.0
    assert seldom("a", "fourth")
    now_s[0] += 61.0
    assert seldom("a", "fifth")
    assert said == [
        ("a", "first"), ("b", "other"), ("a", "fourth (2 more since the last line)"),
        ("a", "fifth"),
    ]  # fmt: skip
