"""`ground_station.replay.cases`: replay cases, accepted runs, and the folders of runs."""

from __future__ import annotations

import json

import numpy as np
from pieces import Picker, as_json, changed, refusing, scratch, stretch, with_a_line

from ground_station.replay.cases.case import load_case
from ground_station.replay.cases.frames import COLUMNS, read_csv
from ground_station.replay.cases.outcome import FRAMES, RESULT, SCHEMA, read_outcome
from ground_station.replay.cases.truth import MARK, read_golden
from pi_firmware.wire.errors import BlimpError

_FOLDER = scratch("cases")
_CASE, _GOLDEN = _FOLDER / "case.toml", _FOLDER / "golden.txt"
(_FOLDER / "flight.mcap").touch()
(_FOLDER / "map").mkdir()
(_FOLDER / "map" / "map.toml").touch()
_WHOLE = b"""\
title = "a case"
recording = "flight.mcap"
map = "map"
init = "none"
rate_hz = 10
[payload]
kinds = ["process"]
settings = ["encoder.bitrate_kbps=800"]
[link]
kind = "proxy"
seed = 1
loss = 0.05
outages = [[5.0, 1.0]]
[truth]
kind = "recording"
[bounds]
position_rmse_m_max = 0.1
[bounds.image]
coverage_min = 0.5
[kinds.image]
rate_hz = 5
"""
_ACCEPTED = f"""\
{MARK}accepted_by = "a"
{MARK}accepted_at = "2026-01-01T00:00:00+00:00"
{MARK}tolerance_m = 0.1
{MARK}tolerance_deg = 1.0
{MARK}missing_max = 0.1
1.5 1 2 3 0 0 0 1
""".encode()
_ROW = ",".join(["1", "2", "3", "4", "5", "TRACKING", "", "0", *["0.5"] * 7, "0" * 32])
_RUN = {
    "schema": SCHEMA, "title": "a run", "rate_hz": 10.0, "seed": 1, "stream": {"packets": 5},
    "outages": [{"begin_ns": 1, "end_ns": 2}], "battery": {"time_ns": 1, "voltage": 3.9},
    "payload_side": {}, "ground_side": {}, "settings": {"a": {"b": 1}}, "notes": ["a note"],
    "accounts": {},
}  # fmt: skip


def fuzz(data: bytes) -> None:
    """What is taken of a run has its poses' numbers, and text that is read twice says the same."""
    picker = Picker(data)
    how = picker.number(1) % 4
    with refusing(BlimpError):
        if how == 0:
            _CASE.write_bytes(with_a_line(picker, _WHOLE))
            load_case(_CASE)
        elif how == 1:
            _GOLDEN.write_bytes(with_a_line(picker, _ACCEPTED))
            assert np.isfinite(read_golden(_GOLDEN).poses.position_m).all()
        elif how == 2:
            rows = [",".join(COLUMNS), *[_ROW] * (picker.number(1) % 3)]
            text = "\n".join(rows).encode() + b"\n" + picker.rest()
            (_FOLDER / FRAMES).write_bytes(text)
            frames = read_csv(_FOLDER / FRAMES)
            assert frames.position_m.shape == (len(frames), 3)
        else:
            (_FOLDER / FRAMES).write_text(f"{','.join(COLUMNS)}\n{_ROW}\n")
            raw = picker.number(1) % 4 == 3
            text = picker.rest() if raw else as_json(changed(picker, _RUN))
            (_FOLDER / RESULT).write_bytes(text)
            assert read_outcome(_FOLDER).run.schema == SCHEMA


def seeds() -> list[bytes]:
    """One of each, with rows and keys that are none."""
    return [
        b"\0\xff" + _WHOLE,
        b"\0\x0coutages = [[0x" + b"f" * 3800 + b"]]",
        b'\0\1recording = "a\\u0000b"',
        b"\1\0" + MARK.encode() + b'accepted_by = "b"',
        b"\1\2" + MARK.encode() + b"tolerance_m = nan",
        b"\2\1",
        b"\2\0" + _ROW.replace("0.5", "nan").encode() + b"\n",
        b"\2\0" + _ROW.replace("1,", "9" * 5000 + ",", 1).encode() + b"\n",
        b'\2\0"a\n',
        b"\3\0",
        b"\3\3" + json.dumps({**_RUN, "rate_hz": 1e300}).encode(),
        stretch((1, b"\0\xff"), (5000, b"a."), (1, b"b = 1")),
        stretch((1, b"\1\1" + MARK.encode()), (3000, b"a."), (1, b"b = 1")),
        stretch((1, b"\3\3"), (5000, b"[")),
        stretch((1, b"\2\0"), (2000, _ROW.encode() + b"\n")),
    ]
