"""NAL units are found as the standard says, and parameter sets are missed when they are missing."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pi_firmware.wire import annexb

STREAMS = Path(__file__).parents[3] / "shared/data/streams"


@settings(deadline=None, max_examples=300)
@given(st.lists(st.sampled_from([0, 0, 0, 1, 2, 3, 4, 255]), max_size=60).map(bytes))
def test_emulation_prevention_hides_start_codes_and_comes_off_again(rbsp: bytes) -> None:
    escaped = annexb.escape(rbsp)
    for forbidden in (b"\x00\x00\x00", b"\x00\x00\x01", b"\x00\x00\x02"):
        assert forbidden not in escaped
    assert annexb.unescape(escaped) == rbsp


@settings(deadline=None, max_examples=100)
@given(st.lists(st.binary(min_size=1, max_size=30), max_size=6), st.booleans())
def test_units_come_back_in_order(bodies: list[bytes], short: bool) -> None:
    code = annexb.START_CODE[1:] if short else annexb.START_CODE
    units = [b"\x41" + annexb.escape(body) + b"\x80" for body in bodies]
    stream = b"".join(code + unit for unit in units)
    assert list(annexb.nal_units(stream)) == units


def test_an_access_unit_without_a_slice_takes_no_unit() -> None:
    with pytest.raises(ValueError, match="no slice"):
        annexb.insert_before_slice(b"\x00\x00\x00\x01\x67\x42\x00\x00\x01", b"\x06\x80")


def test_real_streams_with_and_without_parameter_sets_are_told_apart() -> None:
    if not STREAMS.is_dir():
        pytest.skip("shared/data/streams is not here")
    sets = {annexb.NAL_SPS, annexb.NAL_PPS}
    assert sets <= {*annexb.nal_types((STREAMS / "tello.h264").read_bytes())}
    assert not sets & {*annexb.nal_types((STREAMS / "tello-no-parameter-sets.h264").read_bytes())}
