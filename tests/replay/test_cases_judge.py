"""Judgement: known errors come out as they were made, and nothing passes that was not measured."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cases_stand as stand
import numpy as np
import pytest
import tomli_w
from hypothesis import given, settings
from hypothesis import strategies as st

from ground_station.evaluation.figures import AT_LEAST, AT_MOST, Row, holds_at
from ground_station.geometry.trajectory import Trajectory, write_tum
from ground_station.replay.cases import frames, judge, measure
from ground_station.replay.cases.case import NAMES, Limits, load_case
from ground_station.replay.cases.outcome import Outage, Outcome
from ground_station.replay.cases.truth import Reference, accept, write_golden
from ground_station.replay.resources import Side
from pi_firmware.wire.messages import Battery, Health

TRUTH = Reference(stand.truth(), "the truth")


def rows_of(
    outcome: Outcome, reference: Reference | str | None = TRUTH, **limits: Any
) -> dict[str, Row]:
    found = judge.rows(outcome, Limits(**limits), reference)
    assert len({row.name for row in found}) == len(found)
    return {row.name: row for row in found}


def missed(outcome: Outcome, reference: Reference | str | None = TRUTH, **limits: Any) -> list[str]:
    return [
        row.name for row in rows_of(outcome, reference, **limits).values() if row.holds is False
    ]


ALL: dict[str, Any] = {
    "coverage_min": 1.0,
    "tracking_min": 1.0,
    "lost_max": 0.0,
    "position_rmse_m_max": 1e-6,
    "rotation_rmse_deg_max": 1e-4,
    "position_max_m": 1e-6,
    "latency_p50_ms_max": 40.0,
    "latency_p99_ms_max": 40.0,
    "payload_memory_MB_max": 80.0,
    "ground_memory_MB_max": 300.0,
    "payload_cpu_max": 0.3,
    "battery_V_min": 3.9,
    "battery_V_max": 3.9,
}
"""Bounds that a run without a fault just holds; all but recovery and identity."""


def test_a_perfect_run_holds_every_bound_and_lies_on_them() -> None:
    assert missed(stand.outcome(), **ALL) == []
    assert set(ALL) == set(NAMES) - {"recovery_s_max", "identical"}


def test_errors_that_were_made_are_found() -> None:
    made = [stand.off(k, 0.03 if k % 2 else -0.04) for k in range(60)]
    made[7] = stand.off(7, 0.4, state="DEGRADED")
    made[9] = stand.off(9, 0.3)
    figures = measure.figures(stand.outcome(made), TRUTH)
    squares = 30 * 0.04**2 + 28 * 0.03**2 + 0.4**2 + 0.3**2
    assert figures["position_rmse_m"].value == pytest.approx((squares / 60) ** 0.5)
    assert figures["position_worst_m"].value == pytest.approx(0.4)
    assert figures["tracking_worst_m"].value == pytest.approx(0.3)  # DEGRADED is not called so
    assert "frame 9, of 59 TRACKING" in figures["tracking_worst_m"].told
    assert figures["rotation_rmse_deg"].value == pytest.approx(0.0, abs=1e-5)
    assert figures["tracking"].value == 59 / 60
    turned = [stand.row(k, wTc=stand.true_pose(k) @ _turned(2.0)) for k in range(60)]
    figures = measure.figures(stand.outcome(turned), TRUTH)
    assert figures["rotation_rmse_deg"].value == pytest.approx(2.0)


def _turned(deg: float) -> np.ndarray:
    T = np.eye(4)
    c, s = np.cos(np.radians(deg)), np.sin(np.radians(deg))
    T[1:3, 1:3] = [[c, -s], [s, c]]
    return T


def test_coverage_counts_what_was_sent_and_not_what_came() -> None:
    made = [stand.row(k, wTc=None, state="LOST") if k < 6 else stand.row(k) for k in range(54)]
    run = stand.outcome(made, accounts={"captured": 60, "sent": 60, "lost": 6})
    rows = rows_of(run, coverage_min=0.9, lost_max=0.1, tracking_min=0.9)
    assert rows["coverage_min"].value == 48 / 60 and rows["coverage_min"].holds is False
    assert rows["lost_max"].value == 0.1 and rows["lost_max"].holds is True
    assert rows["tracking_min"].value == 48 / 54 and rows["tracking_min"].holds is False


@pytest.mark.parametrize("name", sorted(NAMES))
def test_a_bound_whose_figure_is_not_there_fails_with_the_reason(name: str) -> None:
    nothing = stand.outcome(
        [], complete=False, battery=None, health=None, payload_side=Side(), ground_side=Side()
    )
    limit: Any = True if name == "identical" else 1.0 if name == "coverage_min" else 60.0
    row = rows_of(nothing, None, **{name: limit})[name]
    assert row.holds is False and row.value is None and row.told
    assert row.measured == "not measured"


@pytest.mark.parametrize(
    ("reference", "says"),
    [
        (None, "this case has no truth"),
        ("survey.txt: No such file", "survey.txt: No such file"),
        (Reference(Trajectory.from_poses([5], [np.eye(4)]), "the survey"), "no pose is within"),
    ],
)
def test_without_a_truth_no_error_is_within_bounds(
    reference: Reference | str | None, says: str
) -> None:
    rows = rows_of(stand.outcome(), reference, position_rmse_m_max=9.0, position_max_m=9.0)
    for name in ("position_rmse_m_max", "position_max_m"):
        assert rows[name].holds is False and says in rows[name].told


def test_no_pose_called_tracking_is_not_a_worst_error_of_zero() -> None:
    run = stand.outcome([stand.row(k, state="DEGRADED") for k in range(60)])
    row = rows_of(run, position_max_m=9.0)["position_max_m"]
    assert row.holds is False and "no pose called TRACKING" in row.told


def test_a_pose_that_is_not_finite_is_no_pose_and_fails() -> None:
    made = [stand.row(k) for k in range(60)]
    made[5] = stand.row(5, wTc=np.full((4, 4), np.nan))
    rows = rows_of(stand.outcome(made), coverage_min=1.0, position_rmse_m_max=1.0)
    assert rows["poses not finite"].holds is False and rows["poses not finite"].value == 1
    assert rows["coverage_min"].value == 59 / 60 and rows["coverage_min"].holds is False
    assert rows["position_rmse_m_max"].holds is True


@pytest.mark.parametrize("place", [1e308, np.inf, 1e9])
def test_a_pose_that_is_nowhere_is_no_pose(place: float) -> None:
    wTc = stand.true_pose(5)
    wTc[0, 3] = place
    run = stand.outcome([stand.row(k, wTc=wTc) if k == 5 else stand.row(k) for k in range(60)])
    rows = rows_of(run, position_rmse_m_max=1.0)
    assert rows["poses not finite"].value == 1 and rows["poses not finite"].holds is False


def test_latency_is_not_measured_by_a_clock_that_never_answered() -> None:
    run = stand.outcome([stand.row(k, captured_ns=frames.UNKNOWN) for k in range(60)])
    row = rows_of(run, latency_p50_ms_max=1e9)["latency_p50_ms_max"]
    assert row.holds is False and "never answered" in row.told


def at_s(seconds: float) -> int:
    return stand.CLOCK_NS + round(seconds * 1e9)


def outages(*spans_s: tuple[float, float]) -> list[Outage]:
    return [Outage(at_s(a), at_s(b), f"outage {k}") for k, (a, b) in enumerate(spans_s, start=1)]


def test_recovery_is_from_an_outages_end_to_a_tracking_pose_of_a_frame_taken_after_it() -> None:
    # Frames 15 to 29 are out; 30 to 35 come back DEGRADED. Frame 14 arrives late, after the end:
    # it was taken before, and is no recovery.
    made = [stand.row(k) for k in range(60) if not 15 <= k < 30]
    made[14] = stand.row(14, done_ns=at_s(1.05))
    made = [stand.row(r.sequence, state="DEGRADED") if 30 <= r.sequence < 36 else r for r in made]
    run = stand.outcome(made, outages=outages((0.5, 1.0)))
    taken_s = 36 * stand.STEP_NS / 1e9
    rows = rows_of(run, recovery_s_max=0.25)
    assert rows["recovery_s_max"].value == pytest.approx(taken_s + 0.04 - 1.0)
    assert rows["recovery_s_max"].holds is True
    assert missed(run, recovery_s_max=0.2) == ["recovery_s_max"]


def test_an_outage_from_which_nothing_came_back_fails_however_wide_the_bound() -> None:
    run = stand.outcome(outages=outages((0.1, 0.2), (1.5, 3.0)))
    row = rows_of(run, recovery_s_max=1e6)["recovery_s_max"]
    assert row.holds is False and row.told == "not TRACKING again after outage 2"


@pytest.mark.parametrize(
    ("counts", "name"),
    [
        ({"captured": 61}, judge.CAPTURED),
        ({"gated": 1}, judge.CAPTURED),
        ({"sent": 61, "captured": 61}, judge.SENT),
        ({"sent": 59, "captured": 59, "lost": -1}, judge.SENT),
        ({"received": 61, "sent": 61, "captured": 61}, judge.RECEIVED),
        ({"dropped": 1}, judge.RECEIVED),
        ({"localized": 59}, judge.RECEIVED),
    ],
)
def test_a_frame_that_is_not_accounted_for_fails(counts: dict[str, int], name: str) -> None:
    assert missed(stand.outcome(accounts=counts)) == [name]


def test_a_frame_that_came_twice_fails_although_the_sums_come_out() -> None:
    made = [stand.row(k) for k in range(59)] + [stand.row(30)]
    rows = rows_of(stand.outcome(made))
    assert rows[judge.SENT].holds is False
    assert "frame 30 was localized 2 times" in rows[judge.SENT].told
    told = rows_of(stand.outcome(stream={"access_units": 70}))[judge.SENT].told
    assert told == "something of 70 frames came, 60 were sent"


def test_counts_that_never_came_do_not_hold() -> None:
    rows = rows_of(stand.outcome(complete=False), coverage_min=0.0)
    assert rows[judge.CAPTURED].holds is False
    assert rows["coverage_min"].holds is False and "did not come" in rows["coverage_min"].told


@pytest.mark.parametrize(
    ("changes", "name", "says"),
    [
        ({"battery": None}, "battery", "no battery message came"),
        ({"battery": Battery(1, 0.2)}, "battery", "voltage is 0.2; allowed: 1 to 60"),
        ({"battery": Battery(1, 3.9, percentage=1.2)}, "battery", "percentage"),
        ({"battery": Battery(1, float("nan"))}, "battery", "voltage is nan"),
        ({"health": None}, "health", "no health message came"),
        ({"health": Health(1, 2.0, cpu=1.5)}, "health", "cpu is 1.5"),
        ({"refused": 2}, "refused", ""),
    ],
)
def test_telemetry_must_be_there_and_in_range(
    changes: dict[str, Any], name: str, says: str
) -> None:
    rows = rows_of(stand.outcome(**changes))
    row = rows[f"telemetry: {name}"]
    assert row.holds is False and says in row.told


@settings(deadline=None, max_examples=200)
@given(st.floats(1e-9, 1e9), st.floats(1e-9, 1e9), st.sampled_from([AT_MOST, AT_LEAST]))
def test_no_rounding_turns_a_miss_into_a_pass(value: float, bound: float, sense: str) -> None:
    holds = holds_at(value, bound, sense)
    row = Row("x", value, "m", bound, holds, sense)
    shown, allowed = (float(text.split()[-2]) for text in (row.measured, row.allowed))
    assert allowed == bound
    assert holds_at(shown, allowed, sense) == holds
    assert (shown == allowed) == (value == bound)


def accepted(outcome: Outcome, **terms: Any) -> Reference:
    usual = {"by": "the bench", "tolerance_m": 0.01, "tolerance_deg": 0.5, "missing_max": 0.1}
    found = accept(outcome, **(usual | terms))
    return Reference(found.poses, str(found), found)


def test_a_run_is_held_against_an_accepted_one_pose_by_pose() -> None:
    reference = accepted(stand.outcome())
    near = stand.outcome([stand.off(k, 0.009) for k in range(60)])
    assert missed(near, reference) == []
    far = stand.outcome([stand.off(k, 0.011 if k == 40 else 0.0) for k in range(60)])
    assert missed(far, reference) == ["golden: position"]
    turned = stand.row(40, wTc=stand.true_pose(40) @ _turned(0.6))
    run = stand.outcome([turned if k == 40 else stand.row(k) for k in range(60)])
    assert missed(run, reference) == ["golden: rotation"]


def test_a_run_without_the_accepted_poses_is_not_within_their_tolerance() -> None:
    reference = accepted(stand.outcome())
    lost = [stand.row(k, wTc=None, state="LOST") if k < 7 else stand.row(k) for k in range(60)]
    rows = rows_of(stand.outcome(lost), reference)
    assert rows["golden: missing"].value == 7 / 60 and rows["golden: missing"].holds is False
    none = stand.outcome([stand.row(k, wTc=None, state="LOST") for k in range(60)])
    names = ["golden: missing", "golden: position", "golden: rotation"]
    assert [name for name in missed(none, reference) if name.startswith("golden")] == names


def test_identical_asks_for_a_second_run_and_every_bit_of_it() -> None:
    one = stand.outcome(stepped=True)
    limits = Limits(identical=True)

    def row(again: Outcome | None) -> Row:
        found = judge.rows(one, limits, None, again)
        return next(r for r in found if r.name == "identical")

    assert row(stand.outcome(stepped=True)).holds is True
    assert row(None).holds is False and row(None).told == "there is no second run"
    wTc = stand.true_pose(12)
    wTc[0, 3] = np.nextafter(wTc[0, 3], 9.0)
    made = [stand.row(k, wTc=wTc) if k == 12 else stand.row(k) for k in range(60)]
    other = row(stand.outcome(made))
    assert other.holds is False and other.value == 1.0 and "frame 12" in other.told
    short = row(stand.outcome([stand.row(k) for k in range(59)]))
    assert short.holds is False and "frame 59 is in the first run only" in short.told
    named = [stand.row(k, state="DEGRADED") if k == 3 else stand.row(k) for k in range(60)]
    assert "is TRACKING and then DEGRADED" in row(stand.outcome(named)).told


def case_of(folder: Path, recorded: Sequence[str] = (), **keys: Any) -> Path:
    stand.recording(folder / "flight.mcap", 60, payloads=recorded)
    (folder / "hall").mkdir(exist_ok=True)
    (folder / "hall" / "map.toml").write_text("")
    document = {"title": "t", "recording": "flight.mcap", "map": "hall", **keys}
    (folder / "c.toml").write_text(tomli_w.dumps(document))
    return folder / "c.toml"


def test_a_case_is_judged_by_the_truth_that_it_names(tmp_path: Path) -> None:
    bounds = {"position_rmse_m_max": 0.02}
    run = stand.outcome([stand.off(k, 0.03) for k in range(60)])
    write_tum(tmp_path / "survey.txt", run.estimate)
    kinds = {"recording": {"kind": "recording"}, "survey": {"kind": "survey", "file": "survey.txt"}}
    found = {}
    for name, truth in kinds.items():
        case = load_case(case_of(tmp_path, truth=truth, bounds=bounds))
        rows = {row.name: row for row in judge.judged(run, case, "process").rows}
        found[name] = rows["position_rmse_m_max"]
    assert found["recording"].value == pytest.approx(0.03) and found["recording"].holds is False
    assert found["survey"].value == pytest.approx(0.0, abs=1e-8) and found["survey"].holds is True


def test_a_case_whose_run_was_never_accepted_fails_and_says_how(tmp_path: Path) -> None:
    truth = {"kind": "golden", "file": "c.golden.txt"}
    case = load_case(case_of(tmp_path, truth=truth, bounds={"position_rmse_m_max": 1.0}))
    judged = judge.judged(stand.outcome(), case, "process", seconds=3.0)
    assert not judged.passed and [row.name for row in judged.missed] == [
        "truth",
        "position_rmse_m_max",
    ]
    assert all("no run was accepted yet; blimp replay --accept" in r.told for r in judged.missed)
    reference = accepted(stand.outcome())
    assert reference.golden is not None
    write_golden(tmp_path / "c.golden.txt", reference.golden)
    assert judge.judged(stand.outcome(), case, "process").passed


def test_golden_without_a_bound_still_needs_its_file(tmp_path: Path) -> None:
    case = load_case(case_of(tmp_path, truth={"kind": "golden", "file": "c.golden.txt"}))
    rows = judge.judged(stand.outcome(), case, "process").rows
    assert [row.name for row in rows if row.holds is False] == ["truth"]
