"""Two runs side by side: every difference is found, and worse than allowed is status 1."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import cases_stand as stand
import numpy as np
import pytest

from ground_station import cli
from ground_station.errors import InputError
from ground_station.replay.cases.compare import Allowed, compare, differing
from ground_station.replay.cases.outcome import Outcome, write_outcome


def moved(dx_m: float, first: int = 20) -> Outcome:
    """The run whose poses are off from frame `first` on."""
    return stand.outcome([stand.off(k, dx_m if k >= first else 0.0) for k in range(60)])


def without_truth(outcome: Outcome) -> Outcome:
    return dataclasses.replace(outcome, truth=None)


def test_a_run_is_identical_to_itself() -> None:
    found = compare(stand.outcome(), stand.outcome(), Allowed(identical=True))
    assert found.identical and not found.failed and found.first.time_ns is None
    assert not found.settings and not found.versions and not found.moves
    assert (found.position_m == 0).all() and len(found.time_ns) == 60


def test_the_difference_of_each_frame_and_the_first_of_them_are_found() -> None:
    found = compare(stand.outcome(), moved(0.3))
    assert not found.identical and found.first.count == 40
    assert found.first.time_ns == stand.START_NS + 20 * stand.STEP_NS
    assert np.allclose(found.position_m, [0.0] * 20 + [0.3] * 40)
    assert "frame 20 is 0.3 m off" in found.first.told
    assert {line.name for line in found.failed} == {"position_rmse_m", "tracking_worst_m"}
    # By the tolerances 0.02 and 0.1 m the RMSE, 0.245, is the worse.
    assert [line.name for line in found.lines[:2]] == ["position_rmse_m", "tracking_worst_m"]
    assert found.lines[0].worse == pytest.approx(0.3 * (40 / 60) ** 0.5)


def test_a_run_that_got_better_is_no_failure() -> None:
    found = compare(moved(0.3), stand.outcome())
    assert not found.failed and not found.identical
    assert next(line for line in found.lines if line.name == "position_rmse_m").worse < 0  # type: ignore[operator]


def test_without_a_truth_the_other_run_is_the_measure() -> None:
    a, b = without_truth(stand.outcome()), without_truth(moved(0.3))
    assert {line.name for line in compare(a, b).failed} == {"position_difference_rms_m"}
    assert not compare(a, b, Allowed(over_m=0.5)).failed
    # The truth of one serves both, where both flew the same.
    assert "position_rmse_m" in {line.name for line in compare(stand.outcome(), b).failed}


def test_the_limit_itself_is_allowed_and_the_next_number_is_not() -> None:
    a, b = stand.outcome(), moved(0.1, first=0)
    worse = next(line for line in compare(a, b).lines if line.name == "position_rmse_m").worse
    assert worse is not None
    quiet = {"over_max_m": None, "over_deg": None, "over_share": None}
    assert not compare(a, b, Allowed(over_m=worse, **quiet)).failed  # type: ignore[arg-type]
    below = float(np.nextafter(worse, 0.0))
    assert compare(a, b, Allowed(over_m=below, **quiet)).failed  # type: ignore[arg-type]


def test_frames_in_only_one_run_are_told_and_count() -> None:
    a = stand.outcome([stand.row(k) for k in range(50)])
    made = [stand.row(k) for k in range(10, 60)]
    b = stand.outcome(made, accounts={"captured": 60, "sent": 60, "lost": 10})
    found = compare(a, b)
    assert (len(found.pairs.a), len(found.pairs.only_a), len(found.pairs.only_b)) == (40, 10, 10)
    assert found.first.count == 20 and "frame 0 is in the first run only" in found.first.told
    assert {"coverage", "lost"} <= {line.name for line in found.failed}


def test_states_that_changed_are_counted() -> None:
    made = [stand.row(k, state="LOST", wTc=None) if k < 6 else stand.row(k) for k in range(60)]
    found = compare(stand.outcome(), stand.outcome(made))
    assert found.moves == {("TRACKING", "LOST"): 6} and found.states["LOST"] == (0, 6)
    assert {line.name for line in found.failed} == {"coverage", "tracking"}
    assert np.isnan(found.position_m[:6]).all()


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"accounts": {"captured": 61}}, "captured = gated + sent + discarded"),
        ({"complete": False}, "coverage"),
    ],
)
def test_an_account_that_no_longer_comes_out_fails(changes: dict[str, Any], name: str) -> None:
    assert name in {line.name for line in compare(stand.outcome(), stand.outcome(**changes)).failed}


def test_a_run_without_any_frame_is_worse() -> None:
    found = compare(stand.outcome(), stand.outcome([]))
    assert {"coverage", "tracking", "position_rmse_m"} <= {line.name for line in found.failed}
    assert any("B: no frame reached" in note for note in found.notes)


def test_latency_is_told_and_fails_only_where_it_is_asked_for() -> None:
    rows = [
        stand.row(k, done_ns=stand.CLOCK_NS + k * stand.STEP_NS + 90_000_000) for k in range(60)
    ]
    a, b = stand.outcome(), stand.outcome(rows)
    line = next(line for line in compare(a, b).lines if line.name == "latency_p50_ms")
    assert (line.a, line.b, line.worse) == (40.0, 90.0, 50.0) and not compare(a, b).failed
    assert [f.name for f in compare(a, b, Allowed(over_ms=49.0)).failed] == ["latency_p50_ms"]


def test_settings_and_versions_that_differ_are_named() -> None:
    b = stand.outcome(
        settings={"localizer": {"seed": 2, "more": 1}}, versions={"ground_station": "0.2.0"},
        preset="thesis",
    )  # fmt: skip
    found = compare(stand.outcome(), b)
    assert found.settings == [
        ("localizer.more", "—", "1"), ("localizer.seed", "1", "2"), ("preset", "default", "thesis"),
    ]  # fmt: skip
    assert found.versions == [("ground_station", "0.1.0", "0.2.0")]
    assert differing({"a": {"b": [1]}}, {"a": {"b": [1]}}) == []


def test_another_flight_is_not_compared() -> None:
    other = stand.outcome([stand.row(k, time_ns=k + 1) for k in range(5)])
    with pytest.raises(InputError, match="it is another flight"):
        compare(stand.outcome(), other)


@pytest.fixture
def folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    write_outcome("a", stand.outcome())
    write_outcome("b", moved(0.3))
    # The page has tests of its own, and its pictures take their time.
    monkeypatch.setattr(
        "ground_station.replay.cases.page.write_comparison",
        lambda path, *_: Path(path).write_text("page"),
    )
    return tmp_path


def test_the_command_says_what_got_worse_and_ends_with_1(
    folders: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["replay", "--compare", "a", "b", "--json", "c.json"]) == 1
    said = capsys.readouterr().out
    assert "40 frames differ; the first at 5.667 s frame 20 is 0.3 m off" in said
    assert "WORSE" in said and (folders / "out" / "compare.html").read_text() == "page"
    told = json.loads((folders / "c.json").read_text())
    assert told["failed"] == ["position_rmse_m", "tracking_worst_m"]
    assert told["differing"] == 40 and len(told["frames"]["position_m"]) == 60
    wide = ["--fail-over-m", "1", "--fail-over-max-m", "1", "--out", "p.html"]
    assert cli.main(["replay", "--compare", "a", "b", *wide]) == 0
    assert cli.main(["replay", "--compare", "a", "a", "--identical", "--out", "p.html"]) == 0
    assert "identical, bit for bit" in capsys.readouterr().out


def test_the_command_accepts_a_run_once(folders: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["replay", "--accept", "a", "--by", "the bench", "--tolerance-m", "0.01",
             "--tolerance-deg", "1", "--out", "g.txt"]  # fmt: skip
    assert cli.main(words) == 0
    assert "60 poses of 60 frames, accepted by the bench" in capsys.readouterr().out
    assert cli.main(words) == 2
    assert "exists already; --force" in capsys.readouterr().err
    assert cli.main([*words, "--force"]) == 0


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (
            ["--compare", "a", "gone"],
            "gone: no run's outcome is there; blimp replay RECORDING --map MAP --out gone",
        ),
        (["--compare", "a", "b", "--out", "p.txt"], "p.txt: the page is an .html file"),
        (["--compare", "a", "b", "--fail-over-m", "nan"], "--fail-over-m is nan; allowed: 0"),
        (["--compare", "a", "b", "--fail-over-deg", "-1"], "--fail-over-deg is -1.0"),
        (["--compare", "a", "b", "--by", "x"], "--by is for --accept"),
        (["--compare", "a", "b", "--tolerance-m", "0"], "--tolerance-m is for --accept"),
        (["--compare", "a", "b", "--map", "m"], "--compare flies nothing: --map"),
        (["x.mcap", "--compare", "a", "b"], "--compare flies nothing: RECORDING"),
        (["--accept", "a", "--compare", "a", "b"], "--accept and --compare are two commands"),
        (["--accept", "a", "--tolerance-m", "1", "--tolerance-deg", "1", "--out", "g"], "--by"),
        (["--accept", "a", "--by", "x"], "--accept needs --out FILE"),
        (["--make-case", "x.mcap", "--out", "c.toml"], "--make-case needs --map MAP"),
        (["--make-case", "x.mcap", "--map", "m"], "--make-case needs --out FILE"),
        (["x.mcap", "--truth", "golden", "--map", "m"], "--truth is for --make-case"),
        (["x.mcap", "--map", "m", "--force"], "--force is for --make-case and --accept"),
    ],
)
def test_words_that_do_not_fit_are_one_line_and_status_2(
    folders: Path, capsys: pytest.CaptureFixture[str], words: list[str], says: str
) -> None:
    assert cli.main(["replay", *words]) == 2
    said = capsys.readouterr().err
    assert said.startswith("blimp replay: ") and says in said and said.count("\n") == 1


def test_the_command_makes_a_case(folders: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stand.recording(folders / "flight.mcap", 60)
    words = ["--make-case", "flight.mcap", "--map", str(stand.SAMPLE), "--truth", "recording"]
    flown = ["--from", "a", "--stepped", "--rate-hz", "10", "--out", "c.toml"]
    assert cli.main(["replay", *words, *flown]) == 0
    assert capsys.readouterr().out == "c.toml\nnext: make hil\n"
    text = (folders / "c.toml").read_text()
    assert "stepped = true" in text and "rate_hz = 10.0" in text
    assert "coverage_min = 0.95" in text
