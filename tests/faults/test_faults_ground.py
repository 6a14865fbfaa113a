"""The link gone, the ground killed, absent or shared: the payload goes on, and is seen again."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path

import pytest
from flight import FRESH_S, ROUND, SMALL_FRAMES, Account, Flight
from ground import Ground, GroundProcess
from payload_process import PayloadProcess, free_port
from waiting import eventually

GONE_S = 10.0
TELEMETRY_S = 20.0  # it is tried again ever more seldom


def fly_without_link(folder: Path, recording: Path) -> Account:
    """A flight whose link is gone for some seconds and must be seen again within 5 s."""
    with Ground() as ground, Flight(folder, ground, recording, *SMALL_FRAMES) as flight:
        flight.wait_streaming(30)
        flight.link.gone(GONE_S)
        time.sleep(GONE_S)
        flight.wait_streaming()
        return flight.finish()


@pytest.fixture(scope="module", autouse=True)
def without_link(
    recording: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Future[Account]]:
    """It flies behind the other tests: what it does is wait."""
    with ThreadPoolExecutor(1) as pool:
        yield pool.submit(fly_without_link, tmp_path_factory.mktemp("gone"), recording)


def test_a_ground_that_is_killed_and_comes_back(recording: Path, tmp_path: Path) -> None:
    """The payload sends straight to its port, so that ICMP says that nobody listens."""
    with GroundProcess() as killed:
        settings = (
            f"camera.uri=replay:{recording}?loop=1",
            f"link.port={killed.port}",
            f"telemetry.connect={json.dumps(killed.endpoints)}",
            *SMALL_FRAMES,
        )
        with PayloadProcess(tmp_path, *settings) as payload:
            assert killed.wait_for(lambda seen: seen.sequence >= 15, 30)
            killed.kill()
            last = killed.frames[-1].sequence
            time.sleep(2)
            with Ground(killed.port, killed.endpoints[0]) as ground:
                fresh = ground.wait_for(lambda _: True, FRESH_S)
                assert fresh is not None and fresh.sequence > last
                again = ground.listener.wait(
                    "blimp-1", lambda s: s.alive and s.battery is not None, TELEMETRY_S
                )
                assert again is not None and ground.listener.clock("blimp-1") is not None
                ended = payload.end()
                seen = killed.frames + ground.frames
    ended.assert_in_order()
    counts = ended.counts
    assert counts["captured"] == counts["sent"] > len(seen)
    sequences = [frame.sequence for frame in seen]
    assert sequences == sorted(set(sequences))
    assert [frame.number for frame in seen] == [sequence % ROUND for sequence in sequences]


def test_a_ground_that_comes_late(recording: Path, tmp_path: Path) -> None:
    port = free_port(socket.SOCK_DGRAM)
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    settings = (
        f"camera.uri=replay:{recording}?loop=1",
        f"link.port={port}",
        f'telemetry.connect=["{endpoint}"]',
        *SMALL_FRAMES,
    )
    with PayloadProcess(tmp_path, *settings) as payload:
        payload.wait_written("payload blimp-1")
        time.sleep(2)
        assert payload.running
        with Ground(port, endpoint) as ground:
            fresh = ground.wait_for(lambda _: True, FRESH_S)
            assert fresh is not None and fresh.sequence > 0
            assert ground.listener.wait("blimp-1", lambda s: bool(s.decisions), TELEMETRY_S)
            ended = payload.end()
    ended.assert_in_order()
    assert [frame.number for frame in ground.frames] == [
        frame.sequence % ROUND for frame in ground.frames
    ]


def test_two_payloads_on_one_port(recording: Path, tmp_path: Path) -> None:
    """Each ground takes one of them, by the SSRC that telemetry announces."""
    with (
        Ground(ssrc=1001) as one,
        Ground(ssrc=1002) as two,
        Flight(
            tmp_path / "1", one, recording, "link.ssrc=1001", *SMALL_FRAMES, payload_id="one"
        ) as first,
        Flight(
            tmp_path / "2", two, recording, "link.ssrc=1002", *SMALL_FRAMES, payload_id="two"
        ) as second,
    ):
        second.link.retarget(one.port)
        first.wait_streaming(30)
        time.sleep(1)
        first.link.retarget(two.port)
        second.link.retarget(two.port)
        second.wait_streaming(30)
        both = [(flight.link, flight.link.counts.passed) for flight in (first, second)]
        eventually(lambda: min(link.counts.passed - before for link, before in both) > 80)
        for ground, name, ssrc in ((one, "one", 1001), (two, "two", 1002)):
            state = ground.listener.wait(name, lambda s: s.ssrc is not None, TELEMETRY_S)
            assert state is not None and state.ssrc == ssrc
        accounts = [first.finish(), second.finish()]
    # Until then packets of strangers are held for who may vouch for them.
    counters = [one.receiver.counters, two.receiver.counters]
    for account, ssrc in zip(accounts, (1001, 1002), strict=True):
        account.assert_in_order()
        account.assert_sent()
        assert {frame.ssrc for frame in account.seen} == {ssrc}
        assert len(account.seen) > 20
    taken = sum(c.packets + c.other_streams for c in counters)
    assert taken == sum(account.link.passed for account in accounts)
    assert min(c.other_streams for c in counters) > 20


def test_a_link_that_was_gone_for_ten_seconds(without_link: Future[Account]) -> None:
    account = without_link.result()
    account.assert_exact()
    # The payload never stopped: what it sent meanwhile was lost, and that was all.
    gone = [frame for frame in account.left if frame.damaged]
    assert len(gone) > 5 * GONE_S and account.link.lost > len(gone)
    longest_ns = max(b.arrival_ns - a.arrival_ns for a, b in pairwise(account.seen))
    assert longest_ns > 0.9 * GONE_S * 1e9
