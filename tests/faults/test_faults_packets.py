"""Packets lost, in bursts, out of order, twice and late: every frame right or accounted for."""

from __future__ import annotations

import contextlib
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from flight import SMALL_FRAMES, Account, Flight
from ground import Ground
from impaired_link import CLEAN, Impairment

BURSTS = Impairment(burst_start=0.01, burst_end=0.15, burst_loss=0.9)
FAULTS = {
    "loss-1": Impairment(loss=0.01),
    "loss-5": Impairment(loss=0.05),
    "loss-20": Impairment(loss=0.2),
    "bursts": BURSTS,
    "reordering": Impairment(reorder=0.2, reorder_by=4),
    "duplicates": Impairment(duplicate=0.2),
    "jitter": Impairment(delay_s=0.02, jitter_s=0.008),
    "all": Impairment(
        loss=0.03, burst_start=0.005, burst_end=0.2, burst_loss=0.8,
        reorder=0.1, duplicate=0.1, delay_s=0.005, jitter_s=0.004,
    ),
}  # fmt: skip
FAULT_S = 4.0


def fly(folder: Path, recording: Path, name: str) -> Account:
    """A clean start, the fault for some seconds, and a clean end, which must come within 5 s."""
    with Ground() as ground, Flight(folder, ground, recording, *SMALL_FRAMES, seed=11) as flight:
        flight.wait_streaming(30)
        flight.link.impair(FAULTS[name])
        time.sleep(FAULT_S)
        flight.link.impair(CLEAN)
        flight.wait_streaming()
        return flight.finish()


@pytest.fixture(scope="module")
def accounts(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Account]:
    """All of them, four at a time: what they do is wait."""
    folder = tmp_path_factory.mktemp("packets")
    with ThreadPoolExecutor(4) as pool:
        flights = {name: pool.submit(fly, folder / name, recording, name) for name in FAULTS}
    result = {}
    for name, flown in flights.items():
        with contextlib.suppress(AssertionError):  # its own test tells, by the name missing here
            result[name] = flown.result()
    return result


@pytest.mark.parametrize("name", FAULTS)
def test_what_is_sent_is_seen_or_lost_and_never_wrong(
    accounts: dict[str, Account], name: str
) -> None:
    assert name in accounts, f"{name}: not streaming again in time"
    accounts[name].assert_exact()


def test_each_fault_did_what_it_is_for(accounts: dict[str, Account]) -> None:
    """A link that impairs nothing would pass all of the above."""
    counts = {name: account.link for name, account in accounts.items()}
    for name, share in (("loss-1", 0.01), ("loss-5", 0.05), ("loss-20", 0.2), ("bursts", 0.05)):
        during = counts[name].received * FAULT_S / (FAULT_S + 2)
        assert 0.2 * share < counts[name].lost / during < 5 * share, name
    for name in ("reordering", "duplicates", "jitter"):
        assert counts[name].lost == 0, name
        assert len(accounts[name].visible) == len(accounts[name].left) > 60
    assert counts["reordering"].delayed > 20 < counts["duplicates"].duplicated
    assert counts["jitter"].delayed > 60
    assert min(counts["all"].lost, counts["all"].duplicated, counts["all"].delayed) > 0
    # In bursts more packets of a frame go together: fewer frames are hit by as many losses.
    damaged = [sum(frame.damaged for frame in accounts[n].left) for n in ("bursts", "loss-20")]
    assert damaged[0] < counts["bursts"].lost and damaged[1] > 10
