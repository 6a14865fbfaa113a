"""`pi_firmware.wire.clock_offset`: answers to questions for the time, and the filter on them."""

from __future__ import annotations

from types import SimpleNamespace

from pieces import Picker, as_json, changed, stretch

from pi_firmware.wire import clock_offset

_ANSWER = {"schema": "blimp.clock/1.0", "received_ns": 10**9, "replied_ns": 10**9 + 1000}


def fuzz(data: bytes) -> None:
    """The offset is a whole number with a bound above 0, whatever was answered."""
    picker, now_ns = Picker(data), 0
    filter_ = clock_offset.OffsetFilter()

    def clock() -> int:
        nonlocal now_ns
        now_ns += 1000 * (1 + picker.number(1))
        return now_ns

    while picker.left():
        how = picker.number(1)
        now_ns += picker.number(5)
        if how & 1:
            now_ns -= picker.number(5)
        if how & 2:
            text = picker.rest()
        else:
            times = {"received_ns": now_ns + picker.number(3), "replied_ns": now_ns}
            times["replied_ns"] += picker.number(4)
            text = as_json(changed(picker, _ANSWER | (times if how & 4 else {})))
        payload = SimpleNamespace(to_bytes=lambda text=text: text)
        replies = [SimpleNamespace(ok=SimpleNamespace(payload=payload))]
        session = SimpleNamespace(get=lambda *_, replies=replies, **__: replies)
        trip = clock_offset.ask(session, "blimp/blimp-1/clock", clock)
        if trip is not None and (offset := filter_.add(trip)) is not None:
            assert type(offset.offset_ns) is int and offset.uncertainty_ns > 0


def seeds() -> list[bytes]:
    """Good answers, a clock that steps, text that is none."""
    good = b"\4" + bytes(5) + b"\1\0\0" + b"\1\0\0\0" + bytes(6)
    return [
        good * 5,
        good + b"\5" + b"\xff" * 10 + good,
        b'\2{"received_ns": 1, "replied_ns": 1e999}',
        stretch((1, b"\2" + bytes(5)), (5000, b"[")),
    ]
