"""Exposure steps, lights that go off and flicker: row by row."""

from __future__ import annotations

import numpy as np
import pytest

from ground_station.geometry.camera import THESIS_CAMERA
from ground_station.simulator.imaging import row_offsets_s
from ground_station.simulator.scene import SimulatorError
from ground_station.simulator.unsteady import unsteady


def test_steps_hold_from_their_time_on() -> None:
    changes = unsteady("1:1,2.5:-1", "4:0.01,5:1")
    assert changes.exposure_ev.at([0, 0.9, 1, 2.4, 2.5, 99]).tolist() == [0, 0, 1, 1, -1, -1]
    assert changes.light.at([0, 4, 4.9, 5]).tolist() == [1, 0.01, 0.01, 1]
    assert unsteady().lit_evenly and unsteady("1:1").lit_evenly and not changes.lit_evenly


def test_bands_are_as_far_apart_as_100_hz_is_in_the_readout() -> None:
    rows_s = row_offsets_s(THESIS_CAMERA)
    light = unsteady(flicker=0.4).row_light(0.5 + rows_s, 0.0)
    assert np.allclose(light, 1 + 0.4 * np.sin(2 * np.pi * 100 * (0.5 + rows_s)))
    # 20 ms of readout are two periods: 240 rows from one band to the next.
    assert np.allclose(light[:240], light[240:], atol=0.01) and np.ptp(light) > 0.79


def test_an_exposure_of_a_whole_period_has_no_bands() -> None:
    rows_s, flicker = row_offsets_s(THESIS_CAMERA), unsteady(flicker=0.4)
    depth = [np.ptp(flicker.row_light(rows_s, s)) / 0.8 for s in (0.0, 0.002, 0.005, 0.01)]
    assert depth == pytest.approx(np.abs(np.sinc([0, 0.2, 0.5, 1.0])), abs=0.01)


def test_light_that_goes_off_while_rows_are_read_is_off_for_the_later_ones() -> None:
    light = unsteady(light_steps="1:0.01").row_light(1.0 + row_offsets_s(THESIS_CAMERA), 0.002)
    assert (light[:200] == 1).all() and light[280:] == pytest.approx(0.01)
    assert (np.diff(light) <= 0).all()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (("1",), "exposure_steps is '1'; such as 5:1,10:0 is meant"),
        (("1:2:3",), "exposure_steps is '1:2:3'"),
        (("1:9",), "allowed values: -6 to 6"),
        (("", "1:nan"), "light_steps is '1:nan'; allowed values: 0 to 64"),
        (("", "2:1,1:1"), "its times must rise"),
        (("", "", 1.5), "flicker is 1.5; allowed: 0 to 1"),
    ],
)
def test_what_is_meant_is_said(given: tuple[str, ...], said: str) -> None:
    with pytest.raises(SimulatorError) as refused:
        unsteady(*given)  # type: ignore[arg-type]
    assert said in str(refused.value)
