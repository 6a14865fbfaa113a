"""The study's figures are what their names say; the study itself is run by hand (study/run.py)."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from study import metrics
from study.feeding import feed, joined
from study.recovering import SETTLED, Settled, draw_places
from study.row import Line
from study.run import NEEDS, ROWS, parser, run, table

from ground_station.geometry import poses
from ground_station.localization.estimate import PoseEstimate, State
from ground_station.recording.frames import Frame


def frames(count: int, step_ns: int = 33_333_333) -> list[Frame]:
    image = np.zeros((4, 4), np.uint8)
    return [Frame(k, str(k), 5 + k * step_ns, image, 0.01) for k in range(count)]


class Still:
    """A localizer that is always at the origin and remembers what it was given."""

    def __init__(self) -> None:
        self.given: list[tuple[int, float | None]] = []

    def process(
        self, time_ns: int, image: np.ndarray, index: int, exposure_s: float | None = None
    ) -> PoseEstimate:
        self.given.append((index, exposure_s))
        return PoseEstimate(time_ns, index, State.TRACKING, wTc=np.eye(4))


def test_errors_are_distance_and_angle_and_nan_where_there_is_no_pose() -> None:
    rng = np.random.default_rng(1)
    true = np.array([poses.exp(xi) for xi in rng.normal(0, 1, (3, 6))])
    moved = true.copy()
    moved[0, :3, 3] += [0.3, 0.0, 0.4]
    moved[1] = true[1] @ poses.exp([0, math.radians(3), 0, 0, 0, 0])
    moved[2] = np.nan
    m, deg = metrics.pose_errors(moved, true)
    np.testing.assert_allclose(m, [0.5, 0, np.nan], atol=1e-9)
    np.testing.assert_allclose(deg, [0, 3, np.nan], atol=1e-6)
    assert metrics.largest(m) == pytest.approx(0.5) and math.isnan(metrics.largest([]))


def recovered(says: list[int], metres: list[float], degrees: float = 0.5) -> metrics.Recovery:
    seconds = 0.1 * np.arange(len(says))
    return metrics.recovery(seconds, says, metres, np.full(len(says), degrees))


def test_recovery_counts_only_tracking_near_the_truth() -> None:
    nan = math.nan
    clean = recovered([0, 0, 0, 1, 1], [9, nan, 0.1, 0.2, 0.1])
    assert clean == metrics.Recovery(pytest.approx(0.3), 0.0, 0, 0.2, 0.5)
    kept = recovered([1, 1, 0, 0, 1], [9, 8, nan, nan, 0.1])
    assert (kept.recovered_s, kept.kept_s, kept.wrong) == (
        pytest.approx(0.4), pytest.approx(0.2), 2
    )  # fmt: skip
    assert kept.worst_m == 9
    later = recovered([0, 1, 1], [nan, 3.0, 0.1])
    assert (later.kept_s, later.wrong) == (0, 1) and later.recovered_s == pytest.approx(0.2)
    turned = recovered([0, 1, 1], [nan, 0.1, 0.1], degrees=5.0)
    assert turned.recovered_s == math.inf and turned.wrong == 2
    never = recovered([0, 0], [nan, nan])
    assert never.recovered_s == math.inf and math.isnan(never.worst_m)
    stuck = recovered([1, 1, 1], [9, 9, nan])
    assert stuck.kept_s == pytest.approx(0.2) and stuck.wrong == 3


def test_percentiles_do_not_pass_between_a_time_and_never() -> None:
    times = [0.1] * 19 + [math.inf]
    assert metrics.percentile_of(times, 50) == metrics.percentile_of(times, 95) == 0.1
    assert metrics.percentile_of([*times, math.inf], 95) == math.inf
    assert metrics.percentile_of([3.0, 1.0, 2.0], 50) == 2.0
    assert math.isnan(metrics.percentile_of([], 50))


def test_every_frame_is_given_with_its_exposure() -> None:
    localizer: Any = Still()
    flown = feed(localizer, frames(5))
    assert localizer.given == [(k, 0.01) for k in range(5)]
    assert flown.says(State.TRACKING).all() and flown.wTc.shape == (5, 4, 4)


def test_a_jump_joins_two_flights_with_times_that_go_on() -> None:
    stream = joined([frames(3), frames(50)[40:42]])
    assert [frame.index for frame in stream] == [0, 1, 2, 3, 4]
    assert np.allclose(np.diff([f.time_ns for f in stream]), 1e9 / 30, atol=1)
    assert stream[3].image is not None and stream[3].name == "40"


def test_places_of_a_jump_are_on_two_flights_and_leave_room() -> None:
    flights: Any = [SimpleNamespace(frames=frames(n)) for n in (100, 60, 80)]
    rng = np.random.default_rng(0)
    drawn = [draw_places(flights, rng, 30, 50) for _ in range(300)]
    assert all(a != b for a, _, b, _ in drawn)
    assert {a for a, *_ in drawn} == {b for _, _, b, _ in drawn} == {0, 1, 2}
    assert all(i + 30 <= len(flights[a].frames) for a, i, _, _ in drawn)
    assert all(j + 50 <= len(flights[b].frames) for _, _, b, j in drawn)


def test_a_table_tells_what_is_met_and_missed() -> None:
    line = Line("demo flight", "<= 0.02 m", "0.0190 m", True, "seed 7")
    text = table([line, replace(line, met=False), replace(line, met=None)]).splitlines()
    assert [row.split()[0] for row in text[::3]] == ["met", "MISSED", "demo"]
    assert "0.0190 m" in text[1] and "seed 7" in text[2]


@pytest.mark.parametrize("row", sorted(NEEDS))
def test_a_row_without_its_flights_is_refused_in_one_line(
    row: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert row in ROWS and run(parser().parse_args([row])) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and f"--{NEEDS[row]}" in error


def test_a_missing_flight_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sample = Path(__file__).parents[2] / "maps/atrium"
    words = ["others", "--map", str(sample), "--others", str(tmp_path / "none.mcap")]
    assert run(parser().parse_args([*words, "--json", str(tmp_path / "a.json")])) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "none.mcap" in error


def test_reasons_are_counted_without_their_numbers() -> None:
    assert metrics.without_numbers("entropy 6.12 below 7 bits") == "entropy # below # bits"
    assert json.dumps(metrics.without_numbers("12 of 30")) == '"# of #"'


def test_a_jump_is_over_when_tracking_near_the_truth_has_settled() -> None:
    first = 10
    truth = np.tile(np.eye(4), (100, 1, 1))
    truth[:15, 0, 3] = 5.0  # the localizer says the origin: near only from the 15th frame on
    localizer: Any = Still()
    flown = feed(localizer, frames(100), Settled(first, truth))
    assert len(flown.frames) == first + 15 + SETTLED
    away = np.tile(np.eye(4), (100, 1, 1))
    away[:, 0, 3] = 5.0
    assert len(feed(localizer, frames(100), Settled(first, away)).frames) == 100
