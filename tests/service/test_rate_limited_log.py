"""What repeats is not said each time."""

from ground_station.service.ending import RateLimitedLog


def test_what_repeats_is_said_once_a_minute_with_its_count() -> None:
    said: list[tuple[str, str]] = []
    now_s = [100.0]
    seldom = RateLimitedLog(lambda name, text: said.append((name, text)), clock=lambda: now_s[0])
    assert seldom("a", "first") and not seldom("a", "second") and seldom("b", "other")
    now_s[0] += 59.0
    assert not seldom("a", "third")
    now_s[0] += 2.0
    assert seldom("a", "fourth")
    now_s[0] += 61.0
    assert seldom("a", "fifth")
    assert said == [
        ("a", "first"), ("b", "other"), ("a", "fourth (2 more since the last line)"),
        ("a", "fifth"),
    ]  # fmt: skip
