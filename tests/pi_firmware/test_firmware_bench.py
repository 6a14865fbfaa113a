"""The bench of the payload: what it reads of callgrind's profiles, and a very short real run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ground_station import cli
from ground_station.bench import callgrind, figures, flight

# Two objects, C's library and code made at run time; names are written once. The lines behind
# `calls=` are the callees' and no cost of the object's own.
PROFILE = """\
# callgrind format
version: 1
positions: line
events: Ir

ob=(1) /usr/lib/libx264.so.164
fl=(1) ???
fn=(1) encode
0 1000
+3 20
cob=(2) /usr/lib/libc.so.6
cfn=(2) memcpy
calls=5 0
* 60

ob=(3) /venv/lib/site-packages/numpy/_core/_multiarray_umath.so
fn=(3) bincount
-2 300
cob=(2)
cfn=(2)
calls=2 0
0 20
cfn=(4) helper
calls=7 0
0 50
cob=(4) ???
cfn=(5) 0x1234
calls=1 0
0 9
fn=(4)
0 50
0

ob=(2)
fn=(2)
12 80

ob=(4)
fn=(5)
0 9

totals: 1459
"""


@pytest.fixture
def profile(tmp_path: Path) -> Path:
    path = tmp_path / "callgrind.out"
    path.write_text(PROFILE)
    return path


def short(code: callgrind.Code) -> tuple[str, str]:
    return Path(code.object).name, code.function


def test_own_costs_are_the_functions_and_calls_are_not(profile: Path) -> None:
    read = callgrind.read(profile)
    numpy = "_multiarray_umath.so"
    assert {short(code): cost for code, cost in read.own.items()} == {
        ("libx264.so.164", "encode"): 1020,
        (numpy, "bincount"): 300,
        (numpy, "helper"): 50,
        ("libc.so.6", "memcpy"): 80,
        ("???", "0x1234"): 9,
    }
    assert {(short(a), short(b)): cost for (a, b), cost in read.called.items()} == {
        (("libx264.so.164", "encode"), ("libc.so.6", "memcpy")): 60,
        ((numpy, "bincount"), ("libc.so.6", "memcpy")): 20,
        ((numpy, "bincount"), (numpy, "helper")): 50,  # no cob: its own object's
        ((numpy, "bincount"), ("???", "0x1234")): 9,
    }


def test_copies_are_charged_to_who_asks_for_them(profile: Path) -> None:
    groups = callgrind.by_group(callgrind.read(profile))
    assert groups["x264"] == pytest.approx(1020 + 60)
    assert groups["numpy"] == pytest.approx(350 + 20 + 9)
    assert sum(groups.values()) == pytest.approx(1459)


CHAINED = """\
events: Ir
ob=(1) /usr/lib/libpython3.11.so.1.0
fn=(1) call
0 100
cob=(2) ???
cfn=(2) trampoline
calls=1 0
0 1000000
ob=(3) /usr/lib/libgstbase-1.0.so.0
fn=(3) chain
0 200
cob=(2)
cfn=(4) scale
calls=1 0
0 600
cob=(5) /usr/lib/libc.so.6
cfn=(5) malloc
calls=3 0
0 40
ob=(2)
fn=(2)
0 8
fn=(4)
0 600
ob=(5)
fn=(5)
0 10
cfn=(6) int_malloc
calls=3 0
0 30
fn=(6)
0 30
cfn=(6)
calls=3 0
0 12
totals: 948
"""


def test_a_trampoline_into_much_does_not_bear_what_others_call(tmp_path: Path) -> None:
    """Both are made at run time, and the call of the one comprises all that it leads to."""
    path = tmp_path / "callgrind.out"
    path.write_text(CHAINED)
    groups = callgrind.by_group(callgrind.read(path))
    assert groups["Python"] == pytest.approx(108)
    assert groups["GStreamer"] == pytest.approx(200 + 600 + 40)  # malloc's inner part, too
    assert groups[callgrind.OTHER] == 0


def test_what_nothing_calls_stays_unassigned(tmp_path: Path) -> None:
    path = tmp_path / "callgrind.out"
    path.write_text("events: Ir\nob=(1) /usr/lib/libc.so.6\nfn=(1) main\n0 7\ntotals: 7\n")
    assert callgrind.by_group(callgrind.read(path))[callgrind.OTHER] == 7


def test_positions_of_two_numbers_and_uncompressed_names(tmp_path: Path) -> None:
    path = tmp_path / "callgrind.out"
    path.write_text(
        "positions: instr line\nevents: Ir\nob=/usr/bin/python3.11\nfn=main\n0x400 7 5\n+4 * 6\n"
        "totals: 11\n"
    )
    assert callgrind.read(path).own == {("/usr/bin/python3.11", "main"): 11}
    assert callgrind.group_of("/usr/bin/python3.11") == "Python"


@pytest.mark.parametrize(
    ("name", "group"),
    [
        ("/usr/lib/x86_64-linux-gnu/gstreamer-1.0/libgstx264.so", "GStreamer"),
        ("/usr/lib/x86_64-linux-gnu/gstreamer-1.0/libgstvideotestsrc.so", "test picture"),
        ("/usr/lib/arm-linux-gnueabihf/libgstbase-1.0.so.0", "GStreamer"),
        ("/venv/lib/python3.11/site-packages/numpy.libs/libscipy_openblas64_-32a4b2a6.so", "numpy"),
        ("/venv/lib/python3.11/site-packages/gi/_gi.so", "bindings (gi, GLib)"),
        ("/usr/lib/libgobject-2.0.so.0", "bindings (gi, GLib)"),
        ("/usr/lib/python3.11/lib-dynload/_json.so", "Python"),
        ("/venv/lib/python3.11/site-packages/zenoh/zenoh.abi3.so", "Zenoh"),
        ("/usr/lib/libsrtp2.so.1", "SRTP"),
        ("/usr/lib/libz.so.1", "other"),
    ],
)
def test_groups(name: str, group: str) -> None:
    assert callgrind.group_of(name) == group


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (PROFILE[: PROFILE.index("ob=(2)\nfn=(2)")], "cut: 1370 instructions and no total"),
        (PROFILE.replace("12 80", "12 8"), "cut: 1387 instructions and a total of 1459"),
        (PROFILE.replace("12 80", "12 eighty"), "line 36: no record"),
        (PROFILE.replace("ob=(3) /venv", "ob=(3)\n#"), "line 16: no record"),
        (PROFILE.replace("events: Ir", "events: Dr Ir"), "counts 'Dr Ir', not instructions"),
        ("", "cut: 0 instructions and no total"),
    ],
)
def test_a_profile_that_is_not_whole_is_one_line(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "callgrind.out"
    path.write_text(text)
    with pytest.raises(callgrind.ProfileError) as caught:
        callgrind.read(path)
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_import_times_are_summed_by_package() -> None:
    text = (
        "import time: self [us] | cumulative | imported package\n"
        "import time:      2000 |       9000 |   numpy._core\n"
        "import time:      1000 |      10000 | numpy\n"
        "import time:       500 |        500 |     json.decoder\n"
        "a line of the program's own\n"
    )
    modules, packages = figures.imports(text)
    assert modules == pytest.approx({"numpy._core": 2e-3, "numpy": 1e-3, "json.decoder": 5e-4})
    assert packages == pytest.approx({"numpy": 3e-3, "the standard library": 5e-4})


def test_the_figures_kept_have_every_group() -> None:
    assert tuple(figures.kept()) == callgrind.GROUPS


def test_the_command_measures_the_real_program(tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.setattr(figures.shutil, "which", lambda _: None)
    out = tmp_path / "bench.json"
    arguments = ["--repetitions", "1", "--seconds", "1", "--json", str(out)]
    assert cli.main(["bench", "payload", *arguments]) == 0
    printed, result = capsys.readouterr().out, json.loads(out.read_text())
    for title in ("Python alone", "first access unit", "resident", "valgrind is not installed"):
        assert title in printed
    start, stream = result["start"], result["stream"]
    assert 0 < start["python_s"] < start["ready_s"] <= start["first_access_unit_s"]
    assert start["packages_s"]["numpy"] > 0 and start["import_s"] < 60
    assert stream["frames"]["gated"] == 0 and stream["received"] == stream["frames"]["sent"]
    assert stream["received"] > 0  # how many is the machine's: 30 if it is quiet
    assert 0 < stream["latency_ms"]["p50"] <= stream["latency_ms"]["p99"]
    assert 30 < stream["resident_mb"] <= stream["peak_mb"] < stream["limit_mb"]
    assert sum(stream["mappings_mb"].values()) <= stream["peak_mb"] * 1.01
    assert result["instructions"] == {}


def test_a_program_that_fails_says_why() -> None:
    with (
        flight.Ground(telemetry=False) as ground,
        flight.fly(ground, ["camera.uri=webcam:"]) as flown,
        pytest.raises(flight.FlightError, match=r"status 2: .*unknown scheme"),
    ):
        flown.end()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--frames", "1"], "--frames is 1; allowed are 2 to 3600"),
        (["--seconds", "nan"], "--seconds is nan; allowed are 0.5 to 3600"),
        (["--repetitions", "0"], "--repetitions is 0; allowed are 1 to 3600"),
        (["--json", "no-such-folder/f.json", "--seconds", "1"], "no folder no-such-folder"),
    ],
)
def test_a_bad_value_is_one_line(arguments, said, capsys) -> None:
    assert cli.main(["bench", "payload", *arguments]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
