"""From runs to tables, verdicts and pages."""

from __future__ import annotations

import json
import math

import kept_runs
import pytest

from ground_station.experiments import report, summary, tables
from ground_station.experiments.store import Store


def document(tmp_path, runs, thesis='thesis.position_m = 0.2\ncause = "it is dark"'):
    """Of one experiment with one case, whose presets have those runs."""
    head = 'seeds = [1, 2]\n[experiment.light]\ntitle = "Light <b>"\n[experiment.light.case.noon]\n'
    return kept_runs.document(tmp_path, f"{head}{thesis}\n", {("light", "noon"): runs})


def test_figures_are_the_mean_and_the_sample_deviation_over_the_seeds(tmp_path):
    good = [kept_runs.run([0.01] * 4), kept_runs.run([0.03] * 4)]
    found = document(tmp_path, {"thesis": [kept_runs.run([0.1] * 4)] * 2, "default": good})
    row = found["experiments"][0]["cases"][0]["presets"]["default"]
    assert row["position_m"]["mean"] == pytest.approx(0.02)
    assert row["position_m"]["std"] == pytest.approx(math.sqrt(2) * 0.01)
    assert (row["position_m"]["min"], row["position_m"]["max"], row["position_m"]["n"]) == (
        pytest.approx(0.01), pytest.approx(0.03), 2,
    )  # fmt: skip
    assert row["localized"] == 1.0 and found["worse"] == []
    assert "In all 1 rows the default is better" in tables.verdict(found)


def test_the_error_over_the_frames_of_both_does_not_reward_giving_up(tmp_path):
    # The thesis's way gives up after the easy half, and so has the smaller error over its own.
    theirs = kept_runs.run([0.02, 0.02, None, None])
    ours = kept_runs.run([0.01, 0.01, 0.08, 0.08])
    found = document(tmp_path, {"thesis": [theirs, theirs], "default": [ours, ours]})
    case = found["experiments"][0]["cases"][0]
    assert (
        case["presets"]["thesis"]["position_m"]["mean"]
        < case["presets"]["default"]["position_m"]["mean"]
    )
    position, rotation = (case["common"]["thesis"][k] for k in ("position_m", "rotation_deg"))
    assert position["theirs"]["mean"] == pytest.approx(0.02)
    assert position["ours"]["mean"] == pytest.approx(0.01)
    assert case["presets"]["thesis"]["localized"] == 0.5
    assert rotation["theirs"]["mean"] == pytest.approx(0.2)
    assert rotation["ours"]["mean"] == pytest.approx(0.1)
    assert case["worse"] == []


@pytest.mark.parametrize(
    ("theirs", "ours", "words"),
    [
        ([0.02] * 4, [0.05] * 4, "position error 5.000 cm, the thesis's method 2.000 cm"),
        ([0.02] * 4, [0.0205] * 4, "position error 2.050 cm, the thesis's method 2.000 cm"),
        ([0.05] * 4, [0.02, 0.02, None, None], "50.0 % of the frames are localized"),
        ([0.05] * 4, [None] * 4, "position error none"),
        ([None] * 4, [None] * 4, "no frame is localized"),
    ],
)
def test_where_ours_is_worse_the_verdict_begins_with_it(tmp_path, theirs, ours, words):
    runs = {"thesis": [kept_runs.run(theirs)] * 2, "default": [kept_runs.run(ours)] * 2}
    found = document(tmp_path, runs)
    assert any(words in line for line in found["worse"]), found["worse"]
    assert tables.verdict(found).startswith("In 1 of 1 rows the default is worse")
    (_, (row, by, why)) = tables.worse(found)
    assert row == "Light <b>, noon" and words in by and why == "it is dark"
    assert words in report.markdown(found).split("\n\n")[1]


def test_as_good_is_not_worse(tmp_path):
    theirs, ours = kept_runs.run([0.02] * 4), kept_runs.run([0.0203] * 4)
    found = document(tmp_path, {"thesis": [theirs] * 2, "default": [ours] * 2})
    assert found["worse"] == [] and "or as good (within 2 %)" in tables.verdict(found)


def test_a_row_is_good_only_where_it_beats_every_rival(tmp_path):
    runs = {
        "thesis": [kept_runs.run([0.05] * 4)] * 2,
        "alone": [kept_runs.run([0.01, 0.01, 0.01, None])] * 2,
        "default": [kept_runs.run([None, 0.02, 0.3, 0.02])] * 2,
    }
    found = document(tmp_path, runs)
    share, position, _, again, _ = (line.split(": ")[1] for line in found["worse"])
    assert share == "75.0 % of the frames are localized, the thesis's method 100.0 %"
    assert position == "position error 17.397 cm, the thesis's method 5.000 cm"
    assert again == "position error 21.260 cm, each frame alone 1.000 cm"
    said = tables.verdict(found)
    assert "worse than the preset thesis and each frame alone (by more than 2 %). " in said
    head, row = tables.every(found["experiments"][0])[1]
    assert row[head.index("wrong TRACKING, frames")] == "2"  # one in each of two runs
    assert row[head.index("found at first after")] == "0.10 ± 0.00 s"
    assert row[head.index("alone and default")] == "1.00 → 21.26 cm"


def test_a_share_is_that_of_the_frames_which_the_rival_saw(tmp_path):
    ours = kept_runs.run([0.01, None, None, 0.01, None, None])
    theirs = kept_runs.run([0.05] * 6, step=3)
    found = document(tmp_path, {"alone": [theirs] * 2, "default": [ours] * 2})
    case = found["experiments"][0]["cases"][0]
    assert case["common"]["alone"]["localized"] == {"ours": 1.0, "theirs": 1.0}
    assert case["presets"]["alone"]["localized"] == 1.0 and found["worse"] == []
    every = kept_runs.run([0.05] * 6)
    (share,) = document(tmp_path, {"alone": [every] * 2, "default": [ours] * 2})["worse"]
    assert "33.3 % of the frames are localized, each frame alone 100.0 %" in share


def test_a_run_that_failed_or_was_not_measured_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(report, "_pictures", lambda *_: [])  # they take their time
    good = kept_runs.run([0.05] * 4)
    runs = {"thesis": [good, good], "default": [{"failed": "no two images overlap"}, None]}
    found = document(tmp_path, runs)
    row = found["experiments"][0]["cases"][0]["presets"]["default"]
    assert row["failed"] == ["no two images overlap", "not measured"]
    assert any("it failed: no two images overlap" in line for line in found["worse"])
    report.write(found, tmp_path / "out")
    page = (tmp_path / "out" / "report.html").read_text()
    assert "no two images overlap" in page and "not measured" in page
    (tmp_path / "both").mkdir()
    both = document(tmp_path / "both", {"thesis": [None, None], "default": [None, None]})
    assert any("all failed: not measured" in line for line in both["worse"])


def test_a_file_of_a_run_that_was_cut_counts_as_not_measured(tmp_path):
    store = Store(tmp_path)
    store.write("a", kept_runs.run([0.1]))
    whole = store.result("a").read_text()
    store.result("a").write_text(whole[: len(whole) // 2])
    assert store.read("a") is None
    store.result("a").write_text("[1]")
    assert store.read("a") is None


def test_the_thesis_s_own_figure_stands_in_a_column_and_in_no_ratio(tmp_path):
    good = [kept_runs.run([0.01] * 4)] * 2
    found = document(tmp_path, {"thesis": [kept_runs.run([0.1] * 4)] * 2, "default": good})
    (head, row), (further, told) = tables.every(found["experiments"][0])
    assert row[head.index("thesis's own*")] == "20.0 cm"
    assert row[head.index("default: position")] == "1.00 ± 0.00 cm"
    assert told[further.index("inside 95 %")] == "95.0 %" and told[0] == row[0] == "noon"
    assert "found again after" not in further  # nothing was covered
    text = report.markdown(found)
    assert report.PRINTED in text and "seeds 1, 2" in text
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert [line.count("|") - 1 for line in lines] == [len(head)] * 3 + [len(further)] * 3


def test_the_page_holds_all_it_shows_and_escapes_names(tmp_path):
    good = [kept_runs.run([0.01, 0.02, 0.01])] * 2
    found = document(tmp_path, {"thesis": [kept_runs.run([0.1] * 3)] * 2, "default": good})
    report.write(found, tmp_path / "out")
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 6  # three pictures in two dresses
    assert "http" not in page.replace("http-equiv", "")
    assert "Light &lt;b&gt;" in page and "<b>" not in page
    assert json.loads((tmp_path / "out" / "results.json").read_text())["seeds"] == [1, 2]


def test_the_longest_time_without_a_pose_counts_the_flight_s_ends(tmp_path):
    # 45 frames at the 15 Hz of an atrium's flight: three seconds; poses from 0.1 s on, till 0.3 s.
    run = kept_runs.run([None, 0.1, None, 0.1, *[None] * 41])
    lost = kept_runs.run([None] * 45) | {"smoothed_m": 0.0}  # of the first pose, that was given
    found = document(tmp_path, {"thesis": [lost, lost], "default": [run, run]})
    presets = found["experiments"][0]["cases"][0]["presets"]
    assert presets["default"]["gap_s"]["max"] == pytest.approx(2.7)
    assert presets["thesis"]["gap_s"]["max"] == pytest.approx(3.0)
    assert presets["thesis"]["smoothed_m"] is None and presets["default"]["smoothed_m"] is not None


def test_times_stand_beside_the_thesis_s_words_for_them(tmp_path):
    runs = {"thesis": [kept_runs.run([0.1])] * 2, "default": [kept_runs.run([0.01])] * 2}
    plain = document(tmp_path, runs)["experiments"][0]
    assert len(tables.every(plain)) == 2 and "median of a frame" not in tables.text(plain)
    told = plain | {"thesis_times": plain["thesis_times"] | {"total": "0.261, 0.256"}}
    head, *rows = tables.every(told)[-1]
    assert head == ["median of a frame, s", "thesis's own*", "noon, preset thesis", "noon, default"]
    assert rows[0] == ["features", "–", "0.0200", "0.0200"]
    assert rows[-1] == ["total", "0.261, 0.256", "0.0500", "0.0500"]
    assert "0.261, 0.256" in tables.text(told)


def test_where_the_map_has_nothing_of_the_flight_whoever_localizes_less_is_better():
    def preset(localized):
        return {"failed": [], "localized": localized}

    shares = {"thesis": preset(0.0), "alone": preset(0.04), "default": preset(0.02)}
    (reason,) = summary.elsewhere(shares)
    assert reason.startswith("2.0 % of the frames are localized where none can be, the thesis")
    assert summary.elsewhere(shares | {"default": preset(0.0)}) == []
    failed = shares | {"default": {"failed": ["no map"], "localized": None}}
    assert summary.elsewhere(failed) == ["it failed: no map"]
