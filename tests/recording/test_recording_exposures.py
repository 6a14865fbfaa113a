"""Every frame of a recording tells its exposure, or that it is not known."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from numbered_video import PERIOD_NS, START_NS

from ground_station.recording.flight import Exposures
from ground_station.recording.frames import plausible_exposure_s
from ground_station.recording.open import open_input, parse_range
from pi_firmware.wire import annexb, sei
from pi_firmware.wire.recording import FRAME_INFO_TOPIC, RecordingWriter, VideoSample

COUNT = 20


def at_ns(k: int) -> int:
    return START_NS + k * PERIOD_NS


def write(
    path: Path,
    units: Sequence[bytes],
    messages: dict[int, Any],
    order: Callable[[int], int] = lambda k: k,
) -> Path:
    """A recording of `units`; `messages` by frame, unit k's written after unit `order(k)`."""
    with RecordingWriter(path, chunk_bytes=1000) as writer:
        for k, unit in enumerate(units):
            writer.write_video(at_ns(k), unit)
            for m, message in messages.items():
                if order(m) == k:
                    writer.write_json(FRAME_INFO_TOPIC, at_ns(m), message, schema_name="frame")
    return path


def exposure_of(k: int) -> float:
    return 0.001 * (k + 1)


def infos(frames: Sequence[int]) -> dict[int, Any]:
    return {k: {"sequence": k, "exposure_s": exposure_of(k), "gain": 1.0} for k in frames}


def test_a_frame_carries_the_exposure_of_its_capture_time(
    tmp_path: Path, access_units: list[bytes]
) -> None:
    frames = list(open_input(write(tmp_path / "a.mcap", access_units[:COUNT], infos(range(COUNT)))))
    assert [f.exposure_s for f in frames] == [exposure_of(k) for k in range(COUNT)]
    part = open_input(tmp_path / "a.mcap", frame_range=parse_range("11:18:3"))
    assert [f.exposure_s for f in part] == [exposure_of(k) for k in (11, 14, 17)]


def test_a_missing_message_leaves_only_its_own_frame_unknown(
    tmp_path: Path, access_units: list[bytes]
) -> None:
    there = [k for k in range(COUNT) if k not in (0, 7, 8, COUNT - 1)]
    path = write(tmp_path / "a.mcap", access_units[:COUNT], infos(there))
    found = [frame.exposure_s for frame in open_input(path)]
    assert found == [exposure_of(k) if k in there else None for k in range(COUNT)]


def test_messages_out_of_order_are_found(tmp_path: Path, access_units: list[bytes]) -> None:
    def shuffled(k: int) -> int:
        return min(k + (7 * k) % 5, COUNT - 1)

    path = write(tmp_path / "a.mcap", access_units[:COUNT], infos(range(COUNT)), shuffled)
    assert [f.exposure_s for f in open_input(path)] == [exposure_of(k) for k in range(COUNT)]


def test_a_recording_without_messages_has_unknown_exposures(
    tmp_path: Path, access_units: list[bytes]
) -> None:
    path = write(tmp_path / "a.mcap", access_units[:COUNT], {})
    assert {frame.exposure_s for frame in open_input(path)} == {None}


def test_what_cannot_be_an_exposure_is_unknown(tmp_path: Path, access_units: list[bytes]) -> None:
    bad: list[Any] = [0, -0.01, 1.5, 10**400, "0.01", None, True, [0.01], {"s": 0.01}]
    messages = {k: {"exposure_s": value} for k, value in enumerate(bad)}
    messages[len(bad)] = {"gain": 1.0}
    messages[len(bad) + 1] = {"exposure_s": 1.0}
    path = write(tmp_path / "a.mcap", access_units[: len(bad) + 2], messages)
    found = [frame.exposure_s for frame in open_input(path)]
    assert found == [None] * (len(bad) + 1) + [1.0]


def test_a_message_that_is_no_json_object_costs_no_other_its_exposure(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    texts = [b"\xff\xfe", b"[1, 2]", b"[" * 100_000, b"{}", b'{"exposure_s": NaN}']
    with RecordingWriter(path) as writer:
        writer.write_json(FRAME_INFO_TOPIC, at_ns(0), infos([0])[0], schema_name="frame")
        for k, text in enumerate(texts, start=1):
            writer._add(FRAME_INFO_TOPIC, at_ns(k), text)
        writer.write_json(FRAME_INFO_TOPIC, at_ns(6), infos([6])[6], schema_name="frame")
    exposures = Exposures(path)
    found = [exposures.of(VideoSample(at_ns(k), b"")) for k in range(8)]
    assert found == [exposure_of(0), *[None] * 5, exposure_of(6), None]


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, -0.0])
def test_numbers_that_are_no_exposure(value: float) -> None:
    assert plausible_exposure_s(value) is None


def test_the_access_unit_is_asked_where_no_message_tells(
    tmp_path: Path, access_units: list[bytes]
) -> None:
    info = sei.FrameInfo(0, at_ns(0), at_ns(0), 7.0, 100.0, exposure_s=0.004)
    unit = annexb.insert_before_slice(access_units[0], sei.encode(info))
    path = write(tmp_path / "a.mcap", [unit, *access_units[1:3]], infos([1]))
    found = [frame.exposure_s for frame in open_input(path)]
    assert found == [pytest.approx(0.004), exposure_of(1), None]
