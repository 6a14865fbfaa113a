"""A path that throws large packets away without a word gets smaller ones."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from pi_firmware.link import Link
from pi_firmware.settings import LinkSettings
from pi_firmware.wire import ulpfec, video
from pi_firmware.wire.messages import LinkReport
from pi_firmware.wire.srtp import TAG_BYTES

UNIT = b"\0\0\0\1\x65" + b"\x55" * 9000
FULL = 1400 - video.OSN_BYTES
"""Room is left for the packet's own number, which comes with it when it is sent again."""


class Sent:
    """A link of the payload's own, and how large its packets of a frame are."""

    def __init__(self, link: Link, receiver: socket.socket) -> None:
        self.link, self._receiver = link, receiver
        self._frames = 0

    def largest(self) -> int:
        self._frames += 1
        assert self.link.send(UNIT, self._frames * 10**9, idr=True)
        sizes, marked = [], False
        while not marked:
            datagram = self._receiver.recv(2000)
            if datagram[1] & 0x7F != video.PAYLOAD_TYPE:
                continue  # a correction
            sizes.append(len(datagram))
            marked = bool(datagram[1] & 0x80)
        return max(sizes)

    def report(self, now_s: float, largest_bytes: int | None, dropped: float) -> None:
        seen = LinkReport(1, "main", 5600, dropped=dropped, largest_bytes=largest_bytes)
        self.link.report(seen, now_s)


@contextmanager
def sending(key: bytes | None = None, **settings: float) -> Iterator[Sent]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(30)
        where = LinkSettings(port=receiver.getsockname()[1], **settings)  # type: ignore[arg-type]
        link = Link(where, 77, key)
        link.start()
        try:
            yield Sent(link, receiver)
        finally:
            link.stop()


@pytest.fixture(params=[None, bytes(range(30))], ids=["plain", "SRTP"])
def sent(request: pytest.FixtureRequest) -> Iterator[Sent]:
    with sending(request.param) as made:
        yield made


def test_packets_get_smaller_until_some_of_full_size_come(
    sent: Sent, capfd: pytest.CaptureFixture[str]
) -> None:
    full = sent.largest()
    assert full <= FULL
    sent.report(10.0, 900, 0.7)
    smaller = sent.largest()
    assert 0.84 * full < smaller < 0.86 * full
    sent.report(11.0, 900, 0.7)  # of packets that were sent before
    assert sent.largest() == smaller
    sent.report(11.5, 900, 0.7)
    least = sent.largest()
    assert 0.84 * smaller < least < 0.86 * smaller
    sent.report(20.0, least, 0.7)  # what is lost now is lost otherwise
    sent.report(30.0, None, 0.0)
    assert sent.largest() == least
    said = capfd.readouterr().err.splitlines()
    assert len(said) == 2 and "do not arrive" in said[0]
    for k in range(20):
        sent.report(40.0 + 2 * k, 100, 0.9)
    assert sent.largest() <= 500 + TAG_BYTES


@pytest.mark.parametrize("seen", [(1384, 0.7), (900, 0.1), (None, 0.9), (900, float("nan"))])
def test_another_loss_leaves_them_as_they_are(sent: Sent, seen: tuple[int | None, float]) -> None:
    full = sent.largest()
    sent.report(10.0, *seen)
    assert sent.largest() == full


def test_corrections_keep_their_room_when_packets_get_smaller() -> None:
    with sending(history_s=0, assumed_loss=0.05) as sent:
        full = sent.largest()
        assert full == 1400 - ulpfec.OVERHEAD_BYTES
        sent.report(20.0, 900, 0.7)
        assert 0.84 * full < sent.largest() < 0.86 * full
