"""`replay:` with pace=stepped: no waiting, no frame lost, the recording's own time throughout."""

import threading
import time
from pathlib import Path

import numpy as np
import pytest
from receiving import Receiver
from tapped import run, words

from ground_station.stream.assembly import ReceivedFrame
from pi_firmware.sources.base import Window
from pi_firmware.sources.schemes.replay import RealTime, Stepped
from pi_firmware.wire.errors import StreamError
from pi_firmware.wire.recording import RecordingReader

FLIGHT = Path(__file__).parents[2] / "maps" / "atrium" / "flight.mcap"
HOUR_NS = 3600 * 10**9
LIMIT_S = 20.0


def test_a_step_waits_for_no_recorded_time() -> None:
    pace = Stepped(1000.0, threading.Event())
    began_s = time.monotonic()
    turns = [pace.turn(10**18 + hour * HOUR_NS) for hour in range(5)]
    assert turns == [hour * HOUR_NS for hour in range(5)]
    assert time.monotonic() - began_s < 600


def test_steps_are_no_more_than_asked_for() -> None:
    pace = Stepped(50.0, threading.Event())
    began_s = time.monotonic()
    for frame in range(6):
        pace.turn(frame)
    assert time.monotonic() - began_s >= 5 / 50.0


def test_a_stop_ends_either_pace_at_once() -> None:
    stopping = threading.Event()
    stopping.set()
    assert Stepped(0.1, stopping).turn(0) is None
    assert RealTime(1.0, lambda: 0, stopping).turn(0) is None
    waiting = Stepped(0.1, later := threading.Event())
    assert waiting.turn(0) == 0
    threading.Timer(0.05, later.set).start()
    assert waiting.turn(HOUR_NS) is None


def test_in_real_time_each_frame_has_its_instant_and_a_faster_one_a_shorter() -> None:
    now = iter([1000, 1000, 10**12, 10**12])
    pace = RealTime(2.0, lambda: next(now), threading.Event())
    assert pace.turn(10**18) == 1000
    assert pace.turn(10**18 + 10**9) == 1000 + 5 * 10**8
    assert pace.turn(10**18 + 2 * 10**9) == 1000 + 10**9


def fly(settings: dict[str, object], options: str = "") -> list[ReceivedFrame]:
    """The sample flight's first four seconds, stepped through the real program to a receiver."""
    with Receiver(0, queue_frames=1000) as receiver:
        uri = f"replay:{FLIGHT}?pace=stepped&duration_s=4{options}"
        given = {"link.port": receiver.port, "telemetry.enabled": False, "camera.uri": uri}
        status, out, err = run(*words(given | settings))
        assert status == 0, err
        frames = []
        while frame := receiver.get(0.5):
            frames.append(frame)
        assert f"{len(frames)} sent" in out
        assert receiver.counters.packets_lost == receiver.dropped == 0
    return frames


def recorded_ns() -> list[int]:
    times = [sample.time_ns for sample in RecordingReader(FLIGHT).video()]
    return [time_ns for time_ns in times if time_ns - times[0] < 4 * 10**9]


def test_a_stepped_flight_loses_no_frame_and_keeps_the_recorded_times() -> None:
    frames = fly({"gate.enabled": False})
    assert [frame.time_ns for frame in frames] == recorded_ns()
    assert [frame.sequence for frame in frames] == list(range(len(frames)))


def test_heartbeats_are_a_second_of_the_recording_apart() -> None:
    gated: dict[str, object] = {"gate.min_entropy_bits": 8, "gate.heartbeat_s": 1}
    frames = fly(gated)
    assert len(frames) == 3 and all(frame.heartbeat for frame in frames)
    apart_s = np.diff([frame.time_ns for frame in frames]) / 1e9
    assert np.all(np.abs(apart_s - 1) < 1 / 30)
    # Another speed, the same flight: the encoder's pictures are equal, too.
    again = fly(gated, options="&max_hz=60")
    assert [frame.sequence for frame in again] == [frame.sequence for frame in frames]
    assert all(np.array_equal(a.image, b.image) for a, b in zip(again, frames, strict=True))


def waiting(window: Window, stopping: threading.Event) -> tuple[threading.Thread, list[bool]]:
    """Someone who waits for room, and what he was told."""
    told: list[bool] = []
    thread = threading.Thread(target=lambda: told.append(window.wait(stopping)), daemon=True)
    thread.start()
    return thread, told


def full(ahead: int) -> Window:
    window = Window(ahead)
    for sequence in range(ahead):
        window.passed(sequence)
    return window


def test_there_is_room_until_as_many_frames_as_allowed_are_on_their_way() -> None:
    window = Window(2)
    assert window.wait(threading.Event())
    window.passed(0)
    assert window.wait(threading.Event())


@pytest.mark.parametrize(
    "free",
    [
        lambda window: window.answered(0),
        lambda window: window.answered(10**9),  # whatever number it is of: nothing breaks
        lambda window: window.gone(2),
    ],
    ids=["answered", "a later one answered", "discarded"],
)
def test_a_full_one_waits_until_a_frame_is_answered_or_gone(free) -> None:  # type: ignore[no-untyped-def]
    window, stopping = full(3), threading.Event()
    thread, told = waiting(window, stopping)
    time.sleep(0.05)
    assert not told
    free(window)
    thread.join(LIMIT_S)
    assert told == [True]


def test_an_answer_to_a_later_frame_answers_those_before_it() -> None:
    window = full(3)
    window.answered(1)  # 0 was lost on its way back
    window.passed(3)
    assert window.wait(threading.Event())
    window.answered(0)  # late, and said already
    window.passed(4)
    thread, told = waiting(window, stopping := threading.Event())
    time.sleep(0.05)
    assert not told
    stopping.set()
    thread.join(LIMIT_S)
    assert told == [False]


def test_nobody_who_answers_is_told_in_one_line() -> None:
    window = Window(1, patience_s=0.0)
    window.passed(7)
    with pytest.raises(StreamError, match="no pose came back for frame 7 within 0 s"):
        window.wait(threading.Event())


def test_a_stop_ends_the_waiting() -> None:
    pace = Stepped(1000.0, stopping := threading.Event(), full(1))
    threading.Timer(0.05, stopping.set).start()
    assert pace.turn(10**18) is None
