"""A frame's numbers survive inside its access unit, and hostile bytes raise nothing."""

import dataclasses
import struct
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pi_firmware.wire import annexb, sei

INFO = sei.FrameInfo(
    sequence=7,
    time_ns=1_700_000_000_123_456_789,
    clock_ns=1_800_000_000_987_654_321,
    entropy_bits=6.5,
    sharpness=120.25,
    exposure_s=0.0078125,
    gain=2.0,
    heartbeat=True,
)
SLICE = b"\x00\x00\x00\x01\x65\x88\x84\x21"
I64 = st.integers(-(2**63), 2**63 - 1)
F32 = st.floats(width=32, allow_nan=False, allow_infinity=False)


def carried(info: sei.FrameInfo, before: bytes = b"") -> bytes:
    return annexb.insert_before_slice(before + SLICE, sei.encode(info))


def with_body(body: bytes) -> bytes:
    payload = sei.UUID + body
    rbsp = bytes([5, len(payload)]) + payload + b"\x80"
    return annexb.insert_before_slice(SLICE, b"\x06" + annexb.escape(rbsp))


def body_of(info: sei.FrameInfo) -> bytes:
    return annexb.unescape(sei.encode(info)[1:])[2 + 16 : -1]


@settings(deadline=None, max_examples=200)
@given(
    st.builds(
        sei.FrameInfo,
        sequence=st.integers(0, 2**32 - 1),
        time_ns=I64,
        clock_ns=I64,
        entropy_bits=F32,
        sharpness=F32,
        exposure_s=st.none() | F32,
        gain=st.none() | F32,
        heartbeat=st.booleans(),
    )
)
def test_every_number_comes_back_exactly(info: sei.FrameInfo) -> None:
    unit = carried(info)
    assert sei.find(unit) == info
    assert annexb.nal_types(unit) == [6, 5]


def test_the_layout_is_the_documented_one() -> None:
    body = body_of(INFO)
    assert struct.unpack(">BBHIqqffff", body) == (
        1, 1, 0, 7, INFO.time_ns, INFO.clock_ns, 6.5, 120.25, 0.0078125, 2.0,
    )  # fmt: skip


def test_it_stands_after_the_parameter_sets_and_before_the_first_slice() -> None:
    before = b"\x00\x00\x00\x01\x67\x42\x00\x1e\x00\x00\x01\x68\xce"
    unit = carried(INFO, before) + b"\x00\x00\x01\x41\x9a"
    assert annexb.nal_types(unit) == [7, 8, 6, 5, 1]


def test_another_programs_sei_is_passed_over() -> None:
    foreign = b"\x00\x00\x01\x06\x05\x14" + b"x264 - core 164 abcd" + b"\x80"
    assert sei.find(foreign + SLICE) is None
    assert sei.find(carried(INFO, foreign)) == INFO


def test_a_later_version_with_more_fields_is_still_read() -> None:
    later = b"\x02" + body_of(INFO)[1:] + b"\x01\x02\x03\x04\x05\x06\x07\x08"
    assert sei.find(with_body(later)) == INFO


@pytest.mark.parametrize("size", range(0, 40))
def test_a_body_cut_short_is_none(size: int) -> None:
    assert sei.find(with_body(body_of(INFO)[:size])) is None


def test_numbers_that_are_not_finite_are_none() -> None:
    assert sei.find(carried(dataclasses.replace(INFO, entropy_bits=float("nan")))) is None
    assert sei.find(carried(dataclasses.replace(INFO, sharpness=float("inf")))) is None


@pytest.mark.parametrize("message", [b"\x04\x00", b"\xff", b"\x04\xff"])
def test_a_unit_of_nothing_but_messages_takes_linear_time(message: bytes) -> None:
    def time_of(count: int) -> float:
        began_s = time.process_time()
        assert sei.find(b"\x00\x00\x01\x06" + message * count) is None
        return time.process_time() - began_s

    # 32 times as many would take 1024 times as long if each looked at all behind it.
    assert time_of(640_000) < 200 * max(time_of(20_000), 1e-3)
