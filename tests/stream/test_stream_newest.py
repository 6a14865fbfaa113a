"""What is let go of where items come faster than they are taken."""

from __future__ import annotations

import pytest

from ground_station.stream import newest
from ground_station.stream.newest import Newest


@pytest.mark.parametrize(
    ("most", "left"),
    [(1, [9]), (2, [8, 9]), (3, [8, 9]), (4, [6, 7, 8, 9]), (8, [4, 5, 6, 7, 8, 9])],
)
def test_the_newer_half_stays_where_there_is_no_room(most: int, left: list[int]) -> None:
    queue: Newest[int] = Newest(most)
    for item in range(10):
        queue.put(item)
    taken = [queue.take(0.0) for _ in left]
    assert taken == left and queue.take(0.0) is None
    assert queue.skipped == 10 - len(left)


def test_what_waited_too_long_is_skipped_but_for_the_newest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    queue: Newest[str] = Newest(8, oldest_s=0.4)
    now_s = 10.0
    monkeypatch.setattr(newest.time, "monotonic", lambda: now_s)
    assert queue.waiting_s == 0.0
    for item in "abc":
        queue.put(item)
        now_s += 0.1
    assert queue.take(0.0) == "a" and queue.waiting_s == pytest.approx(0.2)
    now_s += 0.25
    assert queue.take(0.0) == "c" and queue.skipped == 1
    queue.put("d")
    now_s += 5.0
    assert queue.take(0.0) == "d" and queue.skipped == 1
