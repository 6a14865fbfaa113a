"""A payload whose SSRC is configured restarts: its new session has an account of its own."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ground_station.arrays import Bools
from ground_station.service.intake import payloads
from ground_station.service.intake.payloads import Payload
from ground_station.service.intake.process import Intake
from ground_station.service.intake.recording import GroundRecorder
from ground_station.service.settings import RecordingSettings
from ground_station.stream.assembly import ReceivedFrame
from ground_station.stream.counters import Counters
from pi_firmware.wire import messages


def test_its_first_frames_lost_it_is_told_by_its_word(monkeypatch: pytest.MonkeyPatch) -> None:
    recorder = GroundRecorder(RecordingSettings(folder=""), lambda *_: None)
    recorder.close()
    stream = SimpleNamespace(ssrc=77, counters=Counters(), bytes=0)
    payload = Payload("blimp-1", None, lambda *_: None, recorder)
    payload.follow(stream)  # type: ignore[arg-type]
    listener = SimpleNamespace(name="main", clock=lambda _: None, round_trip_s=lambda _: None)

    def told() -> tuple[int, int]:
        frames = payload.note(None, listener, encrypted=False).frames  # type: ignore[arg-type]
        return frames["received"], frames["damaged"]

    def received() -> int:
        return told()[0]

    def take(
        sequence: int, at_s: float, clock_s: float = 0.0, damaged: Bools | None = None
    ) -> None:
        """At a time, when this machine's clock was set ahead by `clock_s`."""
        monkeypatch.setattr(payloads.time, "monotonic", lambda: at_s)
        arrival_ns = round((at_s + clock_s) * 1e9)
        fate = "decoded" if damaged is None else "damaged"
        counted = {fate: getattr(stream.counters, fate) + 1}
        stream.counters = replace(stream.counters, **counted)
        payload.take(
            ReceivedFrame(
                image=np.zeros((4, 4), np.uint8),
                sequence=sequence,
                time_ns=arrival_ns,
                clock_ns=arrival_ns,
                arrival_ns=arrival_ns,
                entropy_bits=7.0,
                sharpness=1.0,
                exposure_s=None,
                gain=None,
                heartbeat=False,
                ssrc=77,
                damaged=damaged,
            )
        )

    for number in range(5):
        take(number, 100.0 + number / 10)
    assert told() == (5, 0)
    take(5, 103.0)  # a stutter alone is no new session
    assert received() == 6
    payload.started_ns = 99_900_000_000  # this session's own word, heard late
    take(6, 104.0)
    assert received() == 7
    payload.started_ns = 104_500_000_000
    take(9, 105.0)
    take(10, 105.1)
    assert received() == 2
    payload.started_ns = 105_125_000_000  # without a silence it is no session
    take(11, 105.2)
    assert received() == 3
    take(12, 105.3, clock_s=-60.0)  # nor is a clock that is set
    take(13, 105.4)
    assert received() == 5
    take(14, 105.5, damaged=np.ones((1, 1), bool))
    assert told() == (6, 1)
    take(0, 107.0, damaged=np.ones((1, 1), bool))  # the first one of a session
    assert told() == (1, 1)


def test_the_word_of_a_start_is_dated_by_the_payloads_clock() -> None:
    payload = SimpleNamespace(started_ns=0)
    intake = SimpleNamespace(_roster={"blimp-1": payload}, _event=lambda *_: None)
    for name, time_ns in ((messages.EVENT_STARTED, 5), ("stopped", 7)):
        event = messages.Event(time_ns=time_ns, name=name, text="")
        Intake._pass_on(intake, "blimp-1", event)  # type: ignore[arg-type]
    assert payload.started_ns == 5
