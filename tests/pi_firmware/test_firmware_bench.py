"""The bench of the payload: a very short real run, and what it refuses."""

from __future__ import annotations

import json

import pytest

from ground_station import cli
from ground_station.bench import flight


def test_import_times_are_summed_by_package() -> None:
    text = (
        "import time: self [us] | cumulative | imported package\n"
        "import time:      2000 |       9000 |   numpy._core\n"
        "import time:      1000 |      10000 | numpy\n"
        "import time:       500 |        500 |     json.decoder\n"
        "a line of the program's own\n"
    )
    modules, packages = flight.imports(text)
    assert modules == pytest.approx({"numpy._core": 2e-3, "numpy": 1e-3, "json.decoder": 5e-4})
    assert packages == pytest.approx({"numpy": 3e-3, "the standard library": 5e-4})


def test_the_command_measures_the_real_program(tmp_path, capsys) -> None:
    out = tmp_path / "bench.json"
    arguments = ["--repetitions", "1", "--seconds", "1", "--json", str(out)]
    assert cli.main(["bench", "payload", *arguments]) == 0
    printed, result = capsys.readouterr().out, json.loads(out.read_text())
    for title in ("Python alone", "first access unit", "resident", "processor"):
        assert title in printed
    start, stream = result["start"], result["stream"]
    assert 0 < start["python_s"] < start["ready_s"] <= start["first_access_unit_s"]
    assert start["packages_s"]["numpy"] > 0 and start["import_s"] < 60
    assert stream["frames"]["gated"] == 0 and stream["received"] == stream["frames"]["sent"]
    assert stream["received"] > 0  # how many is the machine's: 30 if it is quiet
    assert 0 < stream["latency_ms"]["p50"] <= stream["latency_ms"]["p99"]
    assert 30 < stream["resident_mb"] <= stream["peak_mb"] < stream["limit_mb"]
    assert sum(stream["mappings_mb"].values()) <= stream["peak_mb"] * 1.01


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
        (["--seconds", "nan"], "--seconds is nan; allowed: 0.5 to 3600"),
        (["--repetitions", "0"], "--repetitions is 0; allowed: 1 to 3600"),
        (["--json", "no-such-folder/f.json", "--seconds", "1"], "its folder does not exist"),
    ],
)
def test_a_bad_value_is_one_line(arguments, said, capsys) -> None:
    assert cli.main(["bench", "payload", *arguments]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
