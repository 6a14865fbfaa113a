"""What a long run samples, writes and draws, and what its command line refuses."""

from __future__ import annotations

import importlib.util
import json
import math
import mmap
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from soaking import arguments, report
from soaking.drawing import picture
from soaking.measures import CLOCK, DESCRIPTORS, LATENCY, MEMORY, Measure, Windows
from soaking.processes import Watch, descriptors, memory_MB
from soaking.table import Row

from ground_station.errors import GroundStationError

# By its path: the service's soak has the same name.
_SPEC = importlib.util.spec_from_file_location("flight_soak", Path(__file__).with_name("soak.py"))
assert _SPEC is not None and _SPEC.loader is not None
soak = importlib.util.module_from_spec(_SPEC)
sys.modules["flight_soak"] = soak  # where its dataclasses look for their annotations
_SPEC.loader.exec_module(soak)


def test_windows_tell_the_quantiles_of_each_stretch_once() -> None:
    windows = Windows(10.0)
    told = [windows.add(at_s, at_s) for at_s in np.arange(0.0, 25.0, 0.1)]
    closed = [window for window in told if window is not None]
    assert [window.at_s for window in closed] == [0.0, 10.0]
    assert closed[1].least == pytest.approx(10.0) and closed[1].median == pytest.approx(14.95)
    assert 19.7 < closed[1].p99 <= closed[1].most == pytest.approx(19.9)
    last = windows.close()
    assert last is not None and last.at_s == 20.0 and last.least == pytest.approx(20.0)
    assert windows.close() is None


def test_a_silence_is_no_window() -> None:
    windows = Windows(10.0)
    assert windows.add(1.0, 5.0) is None
    after = windows.add(61.0, 6.0)
    assert after is not None and after.at_s == 0.0
    assert (after.median, windows.close().at_s) == (5.0, 60.0)  # type: ignore[union-attr]


def test_an_open_file_and_a_page_are_seen(tmp_path: Path) -> None:
    before, size = descriptors(os.getpid()), memory_MB(os.getpid())
    assert before is not None and size is not None
    with (tmp_path / "open").open("w"):
        assert descriptors(os.getpid()) == before + 1
        with mmap.mmap(-1, 32_000_000) as held:  # fresh pages: an array may lie in freed ones
            held.write(b"1" * len(held))
            now = memory_MB(os.getpid())
        assert now is not None and now > size + 20


def test_a_process_that_has_gone_has_no_value() -> None:
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as one:
        assert memory_MB(one.pid)
        one.kill()
        os.waitid(os.P_PID, one.pid, os.WEXITED | os.WNOWAIT)  # ended, and nobody has reaped it
        assert memory_MB(one.pid) is None
    assert memory_MB(one.pid) is None and descriptors(one.pid) is None


def test_a_watch_keeps_names_apart_and_tells_a_new_process() -> None:
    watch = Watch({"here": (1.0, 8.0)})
    watch.sample(0.0, {"here": os.getpid(), "there": os.getppid()})
    watch.sample(10.0, {"here": os.getppid()})
    watch.sample(20.0, {"here": os.getppid(), "late": os.getpid()})
    memory = {m.name: m for m in watch.measures if m.kind == MEMORY}
    assert [m.kind for m in watch.measures] == [MEMORY] * 3 + [DESCRIPTORS] * 3
    assert memory["here"].matters == 1.0 and memory["there"].matters is None
    assert [math.isnan(v) for _, v in memory["there"].points] == [False, True, True]
    assert [at_s for at_s, _ in memory["late"].points] == [20.0]
    assert watch.changed == {"here": 1}


def measured(slope: float = 0.0) -> list[Measure]:
    draw = np.random.default_rng(2)
    hours = np.arange(360) / 360
    made = [
        Measure(MEMORY, "payload", "MB", 1.0),
        Measure(DESCRIPTORS, "payload", "files", 8.0, step=1.0),
        Measure(LATENCY, "median", "ms", 5.0),
        Measure(CLOCK, "capture against arrival", "ms", 1.0, both=True),
    ]
    for one, level, size in zip(made, (80, 37, 12, -3), (0.1, 0, 0.5, 0.02), strict=True):
        for hour, noise in zip(hours, draw.normal(size=360), strict=True):
            one.add(3600 * hour, level + slope * hour + size * noise)
    made[0].add(3600.0, None)
    return made


def test_an_earlier_run_is_judged_and_drawn_again(tmp_path: Path) -> None:
    out = tmp_path / "soak.json"
    report.write(out, measured(), 120.0, {"title": "A run"}, [Row("one", "1", "2")])
    assert "NaN" not in out.read_text()
    rows, drawn = report.again(out)
    assert [row.holds for row in rows] == [True] * 4
    assert drawn.read_bytes().startswith(b"\x89PNG") and drawn.with_suffix(".json") == out
    report.write(out, measured(20.0), 120.0, {"title": "A leak"})
    assert [row.holds for row in report.again(out)[0]] == [False] * 4
    assert soak.main(["--again", str(out)]) == 1


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"measures": [{"kind": 1}]}', '{"measures": 3}'])
def test_what_is_no_document_of_a_run_is_refused_in_one_line(
    tmp_path: Path, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "soak.json"
    out.write_text(text)
    with pytest.raises(GroundStationError):
        report.again(out)
    assert soak.main(["--again", str(out)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and str(out) in said


def test_the_picture_has_a_panel_for_each_kind_and_says_slope_and_bound() -> None:
    figure = picture(measured(), 120.0, "A run")
    assert len(figure.axes) == 4
    for axes in figure.axes:
        (text,) = [entry.get_text() for entry in axes.get_legend().get_texts()]
        assert "/h" in text and "bound" in text


def test_the_picture_of_a_run_cut_short_is_drawn_all_the_same(tmp_path: Path) -> None:
    one = Measure(MEMORY, "payload", "MB", 1.0)
    silent = Measure(LATENCY, "median", "ms", 5.0)
    silent.add(0.0, None)
    assert len(picture([one], 120.0, "nothing").axes) == 1
    one.add(0.0, 80.0)
    report.write(tmp_path / "cut.json", [one, silent], 120.0, {"title": "cut"})
    rows, drawn = report.again(tmp_path / "cut.json")
    assert drawn.stat().st_size > 1000 and not any(row.holds for row in rows)


@pytest.mark.parametrize("given", ["0", "-1", "nan", "inf", "many", "1e9"])
def test_hours_out_of_range_are_refused_in_one_line(
    given: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        soak.main(["--hours", given])
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and given in said and "0.02 to 1000" in said


def test_ctrl_c_asks_once() -> None:
    before = signal.getsignal(signal.SIGINT)
    try:
        asked = arguments.on_interrupt()
        assert not asked.is_set()
        signal.raise_signal(signal.SIGINT)
        assert asked.wait(5.0)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_run_that_has_not_ended_leaves_a_document(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "soak.json"
    report.write(out, measured(), 120.0, {"title": "half"})
    document = json.loads(out.read_text())
    assert document["rows"] == [] and len(document["measures"]) == 4
