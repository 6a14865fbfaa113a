"""Which payloads a station leaves to others: by load, with hysteresis, and as a person says."""

from __future__ import annotations

from collections.abc import Iterable

import pytest

from ground_station.service.fleet.allocation import (
    ARRIVAL_S,
    MOVE_S,
    OVERLOADED_S,
    REST_S,
    Allocation,
    Peer,
    Pin,
)

A, B = "blimp-1", "blimp-2"
HEARS = frozenset({A, B})


class Station:
    """A station on a clock of its own."""

    def __init__(self) -> None:
        self.now_s = 1000.0
        self.policy = Allocation("hall", lambda: self.now_s)

    def leaves(
        self,
        here: Iterable[str] = (),
        alone: Iterable[str] = (),
        load: float = 0.5,
        overloaded: bool = False,
        **others: Peer,
    ) -> set[str]:
        """What it leaves now."""
        return set(self.policy.leaves(here, alone, load, overloaded, others))


@pytest.mark.parametrize(
    ("attic", "left"),
    [
        (Peer(0.2, False, HEARS), True),
        (Peer(0.45, False, HEARS), False),  # hardly less
        (Peer(0.2, True, HEARS), False),
        (Peer(0.2, False, frozenset({B})), False),  # it does not hear it
    ],
)
def test_one_that_comes_goes_to_the_station_with_less_load(attic: Peer, left: bool) -> None:
    station = Station()
    assert station.leaves(alone=[A], attic=attic) == ({A} if left else set())
    station.now_s += ARRIVAL_S + 0.1
    assert station.leaves(alone=[A], attic=attic) == set()  # nobody took it


def test_alone_a_station_leaves_nothing() -> None:
    station = Station()
    for _ in range(100):
        station.now_s += 1.0
        assert station.leaves(here=[A], alone=[B], load=2.0, overloaded=True) == set()


def test_a_station_that_is_too_slow_for_long_gives_one_away_and_rests() -> None:
    station, attic = Station(), Peer(0.2, False, HEARS)

    def slow(here: Iterable[str]) -> set[str]:
        return station.leaves(here=here, load=0.9, overloaded=True, attic=attic)

    assert slow([A, B]) == set()
    station.now_s += OVERLOADED_S - 0.1
    assert slow([A, B]) == set()
    station.now_s += 0.2
    assert slow([A, B]) == {B}
    station.now_s += 3.0
    assert slow([A, B]) == {B}
    assert slow([A]) == set()  # it is there
    station.now_s += REST_S - 0.1
    assert slow([A]) == set()
    station.now_s += 0.2
    assert slow([A]) == {A}
    station.now_s += MOVE_S + 0.1
    assert slow([A]) == set()  # nobody took it: it stays


def test_a_moment_of_too_much_moves_nothing() -> None:
    station, attic = Station(), Peer(0.0, False, HEARS)
    for k in range(100):
        station.now_s += 1.0
        overloaded = k % 8 != 0
        assert station.leaves([A], load=0.9, overloaded=overloaded, attic=attic) == set()


def test_a_person_s_choice_holds_over_load_and_the_newest_one_everywhere() -> None:
    station, attic = Station(), Peer(2.0, True, HEARS)
    station.policy.pin(A, Pin("attic", 10))
    assert station.leaves(here=[A, B], attic=attic) == {A}
    assert station.leaves(here=[A, B]) == set()  # that station is not there
    station.policy.pin(A, Pin("hall", 9))  # older, as another station knew it
    assert station.leaves(here=[A, B], attic=attic) == {A}
    station.policy.pin(A, Pin("hall", 11))
    idle = Peer(0.0, False, HEARS)
    station.leaves(here=[A], load=0.9, overloaded=True, attic=idle)
    station.now_s += OVERLOADED_S + 1.0
    assert station.leaves(here=[A], load=0.9, overloaded=True, attic=idle) == set()
    assert station.leaves(here=[A, B], load=0.9, overloaded=True, attic=idle) == {B}


def test_one_that_cannot_go_is_left_for_a_moment_only() -> None:
    station, attic = Station(), Peer(0.2, False, HEARS)
    station.policy.pin(A, Pin("attic", 10))
    assert station.leaves(alone=[A], attic=attic) == {A}
    station.now_s += ARRIVAL_S + 0.1
    assert station.leaves(alone=[A], attic=attic) == set()


def test_what_others_say_is_bounded() -> None:
    station = Station()
    for k in range(1000):
        station.policy.pin(f"blimp-{k}", Pin("attic", k))
    assert len(station.policy.pins) == 64
