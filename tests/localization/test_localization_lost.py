"""The figures of measure_lost.py are what their names say; it is run by hand."""

from __future__ import annotations

import math
from typing import Any

import measure_lost
import numpy as np
import pytest
from measure_lost import BEFORE, SETTLED, Recovery, after_jump, draw_places, recovery

from ground_station.localization.estimate import PoseEstimate, State
from ground_station.recording.frames import Frame


@pytest.mark.parametrize(
    ("says", "metres", "wanted"),
    [
        ([0, 0, 0, 1, 1], [9, math.nan, 0.1, 0.2, 0.1], (0.3, 0.0, 0, 0.2)),
        ([1, 1, 0, 0, 1], [9, 8, math.nan, math.nan, 0.1], (0.4, 0.2, 2, 9)),
        ([0, 1, 1], [math.nan, 3.0, 0.1], (0.2, 0.0, 1, 3.0)),
        ([0, 0], [math.nan, math.nan], (math.inf, 0.0, 0, math.nan)),
        ([1, 1, 1], [9, 9, math.nan], (math.inf, 0.2, 3, 9)),
    ],
)
def test_only_tracking_near_the_truth_is_a_recovery(monkeypatch, says, metres, wanted):
    monkeypatch.setattr(measure_lost, "RATE_HZ", 10.0)
    found = recovery([(s == 1, m, 0.5) for s, m in zip(says, metres, strict=True)])
    assert found == Recovery(*(pytest.approx(value, nan_ok=True) for value in wanted))
    turned = recovery([(s == 1, m, 5.0) for s, m in zip(says, metres, strict=True)])
    assert turned.recovered_s == math.inf and turned.wrong == sum(says)


def test_places_of_a_jump_are_on_two_flights_and_leave_room():
    lengths, rng = (100, 60, 80), np.random.default_rng(0)
    drawn = [draw_places(lengths, rng, 30, 50) for _ in range(300)]
    assert all(a != b for a, _, b, _ in drawn)
    assert {a for a, *_ in drawn} == {b for _, _, b, _ in drawn} == {0, 1, 2}
    assert all(i + 30 <= lengths[a] and j + 50 <= lengths[b] for a, i, b, j in drawn)


class Still:
    """A localizer that is always at the origin and remembers what it was given."""

    def __init__(self) -> None:
        self.given: list[tuple[int, int, float | None]] = []

    def process(self, time_ns: int, image: Any, index: int, exposure_s: float | None) -> Any:
        self.given.append((time_ns, index, exposure_s))
        return PoseEstimate(time_ns, index, State.TRACKING, wTc=np.eye(4))


@pytest.mark.parametrize(("near_from", "used"), [(15, 15 + SETTLED), (70, 70)])
def test_a_jump_is_over_when_tracking_near_the_truth_has_settled(near_from, used):
    image = np.zeros((4, 4), np.uint8)
    frames = [Frame(0, "", 5, image, 0.01) for _ in range(BEFORE + 70)]
    truth = np.tile(np.eye(4), (70, 1, 1))
    truth[:near_from, 0, 3] = 5.0
    localizer: Any = Still()
    found = after_jump(localizer, frames, list(truth))
    assert found.wrong == near_from and len(localizer.given) == BEFORE + used
    times, index, exposure_s = zip(*localizer.given, strict=True)
    assert np.allclose(np.diff(times), 1e9 / 30, atol=1) and set(exposure_s) == {0.01}
    assert index == tuple(range(BEFORE + used))


def test_a_missing_flight_is_one_line(tmp_path, capsys):
    assert measure_lost.main(["--others", str(tmp_path / "none.mcap")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "none.mcap" in error
