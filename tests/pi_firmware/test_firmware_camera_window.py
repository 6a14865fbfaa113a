"""A stepped recording that waits for the ground's answers."""

from __future__ import annotations

import threading
import time

import pytest

from pi_firmware.sources.base import Window
from pi_firmware.sources.schemes.replay import Stepped
from pi_firmware.wire.errors import StreamError

LIMIT_S = 20.0


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
