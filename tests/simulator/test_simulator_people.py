"""People who walk in a simulated flight: where they may, to and fro, and nothing else changes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from quick_flight import quick_settings

from ground_station.simulator import scenes
from ground_station.simulator.imaging import covering_pinhole
from ground_station.simulator.known_points import choose_observations
from ground_station.simulator.people import Walker, walkers
from ground_station.simulator.rendering import Pinhole
from ground_station.simulator.scene import SimulatorError
from ground_station.simulator.simulate import prepare_flight

GREY = np.full(3, 90, np.uint8)


def test_one_goes_to_and_fro_and_turns_round() -> None:
    ends = np.array([[1.0, 2.0], [1.0, 6.0]])
    one = Walker(ends, 1.0, 3.0, np.zeros((64, 64, 3), np.uint8), GREY, GREY)
    assert one.place(0.0) == pytest.approx([1, 5, np.pi / 2])
    assert one.place(2.0) == pytest.approx([1, 5, 3 * np.pi / 2])  # 1 m on, and 1 m back
    assert one.place(4.9) == pytest.approx([1, 2.1, 3 * np.pi / 2])
    assert one.place(7.0)[:2] == pytest.approx([1, 4])


def test_their_ways_are_free_of_what_stands_there() -> None:
    scene = scenes.build("atrium", 12.0)
    crowd, again = (walkers(scene, 30, 100.0, np.random.default_rng(2)) for _ in range(2))
    assert len(crowd) == 30
    assert all(np.array_equal(a.coat, b.coat) for a, b in zip(crowd, again, strict=True))
    assert [one.along_m for one in crowd] == [one.along_m for one in again]
    places = np.array([one.place(t)[:2] for one in crowd for t in np.linspace(0, 40, 300)])
    assert (places > 0.3).all() and (places < np.array(scene.size_m[:2]) - 0.3).all()
    for thing in scene.footprints:
        if thing.kind != "balcony":
            low, high = np.array(thing.bounds_m[:2]), np.array(thing.bounds_m[2:])
            assert not ((places > low) & (places < high)).all(axis=1).any(), thing


def test_where_there_is_no_room_for_them_it_is_said() -> None:
    narrow = replace(scenes.build("corridor", 12.0), size_m=(2.0, 2.0, 3.0))
    with pytest.raises(SimulatorError, match="'corridor' has no room for 5 people"):
        walkers(narrow, 5, 100.0, np.random.default_rng(1))


def test_points_are_clicked_where_those_who_walk_stand_at_that_time(tmp_path: Path) -> None:
    flight = prepare_flight(quick_settings(tmp_path / "f.mcap"))
    stood: list[float] = []

    class Hidden:
        """Everything is behind somebody."""

        def at(self, time_s: float) -> None:
            stood.append(time_s)

        def depth(self, _wTc: np.ndarray, pinhole: Pinhole) -> np.ndarray:
            return np.zeros((pinhole.height_px, pinhole.width_px))

    with pytest.raises(SimulatorError):
        choose_observations(
            Hidden(), covering_pinhole(flight.camera, 0.5), flight.camera, flight.motion,
            flight.times_s, flight.scene.known_points, flight.clicks,
        )  # type: ignore[arg-type]  # fmt: skip
    assert stood == flight.times_s.tolist()
