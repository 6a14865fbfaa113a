"""What is let go of where items come faster than they are taken."""

from __future__ import annotations

import pytest

from ground_station.stream.newest import Newest


@pytest.mark.parametrize(
    ("most", "left"),
    [(1, [9]), (2, [8, 9]), (3, [8, 9]), (4, [6, 7, 8, 9]), (8, [4, 5, 6, 7, 8, 9])],
)
def test_the_newer_half_stays_where_there_is_no_room(most: int, left: list[int]) -> None:
    newest: Newest[int] = Newest(most)
    assert newest.last is None
    for item in range(10):
        newest.put(item)
        assert newest.last == item
    taken = [newest.take(0.0) for _ in left]
    assert taken == left and newest.take(0.0) is None
    assert newest.skipped == 10 - len(left)
