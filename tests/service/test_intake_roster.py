"""Which payloads are taken up, and whose a stream is taken for."""

from __future__ import annotations

from ground_station.service.intake.payloads import Payload
from ground_station.service.intake.recording import GroundRecorder
from ground_station.service.intake.roster import GRACE_S, NAMELESS_S, Announced, Roster
from ground_station.service.settings import PayloadSettings, RecordingSettings

LONG_S = 2 * NAMELESS_S


class Clock:
    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def made(announced: Announced, clock: Clock | None = None, **settings: object) -> Roster:
    recorder = GroundRecorder(RecordingSettings(folder=""), lambda *_: None)
    recorder.close()
    return Roster(
        PayloadSettings(**settings),  # type: ignore[arg-type]
        announced,
        lambda payload_id: Payload(payload_id, None, lambda *_: None, recorder),
        clock or Clock(),
    )


def test_a_stream_is_whose_it_is_announced_as_at_once() -> None:
    announced = Announced()
    roster = made(announced)
    assert roster.owner(7, None, 0.0) is None
    announced.said("blimp-1", 7)
    assert roster.owner(7, None, 0.0) == "blimp-1"
    announced.said("blimp-2", 7)  # who says so first has it
    assert roster.owner(7, None, 0.0) == "blimp-1"
    assert roster.owner(8, None, LONG_S) is None  # others announce theirs: this one is nobody's


def test_with_keys_only_the_keys_owner_counts() -> None:
    announced = Announced()
    roster = made(announced)
    announced.said("blimp-2", 7)
    assert roster.owner(7, "blimp-1", 0.0) is None
    assert roster.owner(7, "blimp-1", GRACE_S + 1) == "blimp-1"  # it never announced another
    announced.said("blimp-1", 9)
    # What it sent in an earlier flight is authentic, too, and could be played back.
    assert roster.owner(7, "blimp-1", LONG_S) is None
    assert roster.owner(9, "blimp-1", 0.0) == "blimp-1"


def test_without_telemetry_a_stream_is_taken_after_a_while() -> None:
    assert made(Announced()).owner(0xAB, None, GRACE_S + 1) is None
    assert made(Announced()).owner(0xAB, None, LONG_S) == "stream-000000ab"
    assert made(Announced(), ids=["blimp-3"]).owner(0xAB, None, LONG_S) == "blimp-3"
    assert made(Announced(), ids=["blimp-3", "blimp-4"]).owner(0xAB, None, LONG_S) is None


def test_there_is_place_for_so_many_and_the_gone_make_room() -> None:
    roster = made(Announced(), most=2)
    one, two = roster.take_up("one"), roster.take_up("two")
    assert one is not None and two is not None
    one.alive = two.alive = True
    assert roster.take_up("three") is None and roster.refused == {"three"}
    assert roster.take_up("one") is one
    two.alive = False
    assert roster.take_up("three") is not None and roster.refused == set()
    assert [payload.id for payload in roster.all()] == ["one", "three"]


def test_who_flies_with_another_station_takes_no_place_from_who_does_not() -> None:
    roster = made(Announced(), most=2)
    first, second = roster.take_up("blimp-1"), roster.take_up("blimp-2", elsewhere=True)
    assert first is not None and second is not None
    first.alive = second.alive = True
    second.station = "attic"
    assert roster.take_up("blimp-3", elsewhere=True) is None and roster.refused == set()
    assert roster.take_up("blimp-4") is not None  # it flies here, or with nobody yet
    assert [payload.id for payload in roster.all()] == ["blimp-1", "blimp-4"]
    roster.get("blimp-4").alive = True  # type: ignore[union-attr]
    assert roster.take_up("blimp-5") is None and roster.refused == {"blimp-5"}


def test_who_found_no_place_and_went_is_forgotten() -> None:
    roster = made(Announced(), clock := Clock(), most=1)
    one = roster.take_up("one")
    assert one is not None
    one.alive = True
    for _ in range(3):  # it is asked for as long as it lives
        assert roster.take_up("two") is None and roster.refused == {"two"}
        clock.now_s += 6.0
    clock.now_s += 6.0
    assert roster.refused == set()


def test_only_those_named_are_taken_up() -> None:
    roster = made(Announced(), ids=["one"])
    assert roster.take_up("two") is None and roster.take_up("one") is not None
    assert roster.refused == set()


def test_who_announces_no_more_makes_room_for_who_does() -> None:
    announced = Announced(clock := Clock())
    for number in range(70):
        announced.said(f"blimp-{number}", number)
    assert announced.ssrc("blimp-69") is None  # 64 announce at once
    clock.now_s += 10.0
    announced.said("blimp-0", 0)
    announced.said("blimp-69", 69)
    assert announced.ssrc("blimp-69") == 69 and announced.ssrc("blimp-0") == 0
    assert announced.ssrc("blimp-1") is None


def test_a_restart_is_no_dispute_and_two_programs_of_one_id_are() -> None:
    announced = Announced(clock := Clock())
    for ssrc in (1, 1, 2, 2, 3):
        announced.said("blimp-1", ssrc)
    assert not announced.disputed("blimp-1") and announced.ssrc("blimp-1") == 3
    announced.said("blimp-1", 2)
    assert announced.disputed("blimp-1")
    assert announced.by(2, None) == announced.by(3, None) == "blimp-1"
    clock.now_s += 10
    assert not announced.disputed("blimp-1")
    assert announced.by(2, None) == "blimp-1" and announced.by(3, None) is None


def test_what_strangers_announce_is_bounded() -> None:
    announced = Announced()
    for number in range(1000):
        announced.said(f"p{number}", number)
        announced.said("p0", number)
    assert len(announced._heard) <= 64
    assert all(len(heard) <= 4 for heard in announced._heard.values())
