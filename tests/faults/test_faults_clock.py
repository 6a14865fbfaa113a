"""The payload's clock stepped by an hour: its frames go on, and their ages stay exact."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from flight import SMALL_FRAMES, Flight
from ground import Ground
from shims import Shim

from pi_firmware.wire import messages

HOUR_NS = 3_600_000_000_000
EXACT_NS = 1_000_000  # what capture times promise


@pytest.mark.parametrize("step_ns", [-HOUR_NS, HOUR_NS], ids=["back", "forward"])
def test_a_clock_that_is_stepped(recording: Path, tmp_path: Path, step_ns: int) -> None:
    clock = Shim(tmp_path, "stepped_clock")
    with (
        Ground() as ground,
        Flight(tmp_path, ground, recording, *SMALL_FRAMES, env=clock.env) as flight,
    ):

        def offset_error_ns(true_ns: int, within_s: float) -> int | None:
            """Waits for an offset that holds the truth within its own bound, and is exact."""
            until_s = time.monotonic() + within_s
            while time.monotonic() < until_s:
                found = ground.listener.clock("blimp-1")
                error_ns = abs(found.offset_ns - true_ns) if found else HOUR_NS
                if found and error_ns <= min(found.uncertainty_ns, EXACT_NS):
                    return error_ns
                time.sleep(0.05)
            return None

        flight.wait_streaming(30)
        assert offset_error_ns(0, 10) is not None
        time.sleep(0.5)
        clock.set(step_ns)
        stepped_ns = time.time_ns()
        flight.wait_streaming()
        # How soon is what `make faults` asks: beside others, round trips take as long as they take.
        assert offset_error_ns(step_ns, 30) is not None
        found = ground.listener.clock("blimp-1")
        assert found is not None and found.steps == 1
        known_ns = time.time_ns()
        flight.wait_streaming()
        time.sleep(1)
        account = flight.finish()
    account.assert_exact()
    state = ground.listener.state("blimp-1")
    assert state is not None  # nothing was restarted for a clock
    assert {event.name for event in state.events} == {
        messages.EVENT_STARTED,
        messages.EVENT_STOPPED,
    }
    # Latencies: before the step by the true clock, after it by the offset that was found.
    before = [s.arrival_ns - s.clock_ns for s in account.seen if s.arrival_ns < stepped_ns]
    after = [
        s.arrival_ns - found.to_ours(s.clock_ns) for s in account.seen if s.arrival_ns > known_ns
    ]
    assert len(before) > 3 and len(after) > 15
    for latencies_ns in (before, after):
        assert min(latencies_ns) > -EXACT_NS and max(latencies_ns) < 2_000_000_000
