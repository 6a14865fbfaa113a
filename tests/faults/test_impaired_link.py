"""The impaired link keeps its promises: exact counts, the same fate for the same seed."""

from __future__ import annotations

import socket
import time

import pytest
from impaired_link import Bottleneck, ImpairedLink, Impairment, LinkCounts

LIMIT_S = 30.0
PACKETS = 400


def relayed(
    impairment: Impairment, *, seed: int = 0, count: int = PACKETS, size: int = 100
) -> tuple[list[int], list[bool], LinkCounts]:
    """Numbers of the packets that arrive, which of all were lost, and the counts.

    All are in the link's socket before it looks at the first, so that none is late.
    """
    fates: list[bool] = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as to:
        to.bind(("127.0.0.1", 0))
        to.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        link = ImpairedLink(
            to.getsockname()[1], impairment, seed=seed, tap=lambda _, lost: fates.append(lost)
        )
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            for number in range(count):
                out.sendto(number.to_bytes(size, "big"), ("127.0.0.1", link.port))
        with link:
            until_s = time.monotonic() + LIMIT_S
            while link.counts.received < count and time.monotonic() < until_s:
                time.sleep(0.01)
        counts = link.counts
        to.setblocking(False)
        arrived = []
        for _ in range(counts.passed + counts.duplicated):
            arrived.append(int.from_bytes(to.recv(65535), "big"))
        with pytest.raises(BlockingIOError):
            to.recv(65535)
    return arrived, fates, counts


def test_what_does_not_fit_the_rate_is_lost_and_counted() -> None:
    """1,000 bytes take a second at 8 kbit/s: four find a place in a queue of 3.5 s, six do not."""
    arrived, fates, counts = relayed(Impairment(rate_kbps=8, queue_s=3.5), count=10, size=1000)
    assert arrived == [0, 1, 2, 3]
    assert fates == [False] * 4 + [True] * 6
    assert counts == LinkCounts(received=10, passed=4, lost=6, overflowed=6, delayed=4)


def test_a_rate_that_is_kept_delays_by_the_packets_own_length() -> None:
    link, does = Bottleneck(), Impairment(rate_kbps=800, queue_s=0.015)
    assert link.wait_s(1000, 5.0, does) == pytest.approx(0.01)
    assert link.wait_s(1000, 5.0, does) == pytest.approx(0.02)
    assert link.wait_s(1000, 5.0, does) is None  # it would wait for 20 ms
    assert link.wait_s(1000, 5.005, does) == pytest.approx(0.025)
    assert link.wait_s(1000, 9.0, does) == pytest.approx(0.01)  # the queue has run empty
    assert link.wait_s(1000, 9.0, Impairment()) == 0.0


def test_without_a_rate_nothing_overflows() -> None:
    arrived, _, counts = relayed(Impairment())
    assert arrived == list(range(PACKETS))
    assert counts == LinkCounts(received=PACKETS, passed=PACKETS)


def test_the_seed_decides_and_the_counts_are_exact() -> None:
    impairment = Impairment(loss=0.1, burst_start=0.02, burst_end=0.3, duplicate=0.1)
    first, fates, counts = relayed(impairment, seed=3)
    again, fates_again, counts_again = relayed(impairment, seed=3)
    assert (first, fates, counts) == (again, fates_again, counts_again)
    assert fates != relayed(impairment, seed=4)[1]
    assert counts.lost == sum(fates) > 0 and counts.duplicated == len(first) - len(set(first)) > 0
    assert sorted(set(first)) == [k for k, lost in enumerate(fates) if not lost]
    assert counts.received == counts.passed + counts.lost == PACKETS


def test_nothing_passes_in_an_outage_and_all_does_behind_it() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as to:
        to.bind(("127.0.0.1", 0))
        to.settimeout(LIMIT_S)
        with (
            ImpairedLink(to.getsockname()[1], outages=[(0.0, 0.3)]) as link,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out,
        ):
            assert link.first_s is None
            begun_s, sent = time.monotonic(), 0
            while link.counts.passed == 0 and time.monotonic() < begun_s + LIMIT_S:
                out.sendto(b"here", ("127.0.0.1", link.port))
                sent += 1
                time.sleep(0.02)
            assert to.recv(16) == b"here"
            assert link.first_s is not None and time.monotonic() - link.first_s >= 0.3
            assert link.counts.lost >= 1


@pytest.mark.parametrize(("loss", "least", "most"), [(0.0, 100, 100), (0.3, 50, 90)])
def test_what_comes_back_goes_to_the_sender_as_late_and_as_lost(
    loss: float, least: int, most: int
) -> None:
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as to,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out,
    ):
        for side in (to, out):
            side.bind(("127.0.0.1", 0))
            side.settimeout(LIMIT_S)
        with ImpairedLink(to.getsockname()[1], Impairment(delay_s=0.02), seed=1) as link:
            out.sendto(b"there", ("127.0.0.1", link.port))
            _, relay = to.recvfrom(100)
            link.impair(Impairment(loss=loss, delay_s=0.02))
            began_s = time.monotonic()
            for number in range(100):
                to.sendto(bytes([number]), relay)
            back = [out.recv(100)]
            assert time.monotonic() - began_s >= 0.02
            out.settimeout(0.5)
            try:
                while True:
                    back.append(out.recv(100))
            except TimeoutError:
                pass
            assert least <= len(back) == link.returned <= most and back == sorted(back)
            assert link.counts.received == 1
