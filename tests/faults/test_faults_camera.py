"""A camera that goes or hangs, an encoder that stalls: restarted in the process, or with it."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import pytest
from flight import FRESH_S, Account, Flight
from ground import Ground
from payload_process import LIMIT_S
from shims import Shim

from pi_firmware.wire import messages

SMALL = (
    "camera.width_px=160",
    "camera.height_px=120",
    "camera.rate_hz=15",
    "gate.enabled=false",
    "supervision.frame_timeout_s=1",
)
TAKES_AND_GIVES_NONE, DOES_NOT_COME_BACK = 1, 2
HOPELESS = 3
"""Exit status by which systemd starts the process again."""


@contextlib.contextmanager
def streaming(
    folder: Path, camera: str, *settings: str, env: Mapping[str, str] | None = None
) -> Iterator[tuple[Ground, Flight]]:
    """A flight with this camera, once it streams."""
    with (
        Ground(numbered=False) as ground,
        Flight(folder, ground, None, *SMALL, *settings, camera=camera, env=env) as flight,
    ):
        flight.wait_streaming(LIMIT_S)
        yield ground, flight


def events_of(ground: Ground) -> list[str]:
    """The names of what the payload announced."""
    state = ground.listener.state("blimp-1")
    return [event.name for event in state.events] if state else []


def wait_for_gap(flight: Flight, seconds: float) -> float:
    """Waits until no frame has left the payload for so long; the time of the last one."""
    last, since_s = -1, time.monotonic()
    until_s = since_s + LIMIT_S
    while time.monotonic() < until_s:
        left = len(flight.witness.left())
        if left != last:
            last, since_s = left, time.monotonic()
        if time.monotonic() - since_s > seconds:
            return since_s
        time.sleep(0.02)
    raise AssertionError("the fault did not come")


def assert_accounted(account: Account) -> None:
    """Whole, and each number that was skipped is one that the payload discarded."""
    account.assert_exact()
    assert len(account.seen) == len(account.left)
    sequences = [frame.sequence for frame in account.left]
    skipped = set(range(account.ended.counts["captured"])) - set(sequences)
    assert len(skipped) == account.ended.counts["discarded"]


def fly_without_camera(folder: Path) -> tuple[Account, list[str]]:
    """A flight whose camera is gone for 3 s and must be seen again within 5 s of its return."""
    with streaming(folder, "test:?gone_at_s=5&gone_for_s=3") as (ground, flight):
        gone_s = wait_for_gap(flight, 1)
        flight.wait_streaming(gone_s + 3 + FRESH_S - time.monotonic())
        time.sleep(0.5)
        account = flight.finish()
        return account, events_of(ground)


@pytest.fixture(scope="module", autouse=True)
def without_camera(
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[Future[tuple[Account, list[str]]]]:
    """It flies behind the other tests: what it does is wait."""
    with ThreadPoolExecutor(1) as pool:
        yield pool.submit(fly_without_camera, tmp_path_factory.mktemp("gone"))


def test_a_camera_that_hangs_is_opened_anew(tmp_path: Path) -> None:
    with streaming(tmp_path, "test:?hang_at_s=3&hang_for_s=60") as (ground, flight):
        wait_for_gap(flight, 0.6)
        flight.wait_streaming()
        time.sleep(0.5)
        account = flight.finish()
        events = events_of(ground)
    assert_accounted(account)
    assert events.count(messages.EVENT_CAMERA_RESTARTED) == 1
    assert events.count(messages.EVENT_STREAMING_AGAIN) == 1


def test_an_encoder_that_gives_nothing_is_opened_anew(tmp_path: Path) -> None:
    encoder = Shim(tmp_path, "encoder_fault")
    with streaming(tmp_path, "test:", env=encoder.env) as (ground, flight):
        encoder.set(TAKES_AND_GIVES_NONE)
        assert ground.listener.wait_for_event("blimp-1", messages.EVENT_ENCODER_RESTARTED, LIMIT_S)
        encoder.set(0)
        flight.wait_streaming()
        time.sleep(0.5)
        account = flight.finish()
        events = events_of(ground)
    assert_accounted(account)
    assert account.ended.counts["discarded"] > 10
    assert messages.EVENT_STREAMING_AGAIN in events
    assert messages.EVENT_FAILED not in events


def test_a_flight_that_ends_while_the_encoder_gives_nothing_accounts_for_what_it_took(
    tmp_path: Path,
) -> None:
    encoder = Shim(tmp_path, "encoder_fault")
    with streaming(tmp_path, "test:", env=encoder.env) as (_, flight):
        encoder.set(TAKES_AND_GIVES_NONE)
        time.sleep(0.4)  # not long enough to be noticed
        account = flight.finish()
    assert_accounted(account)
    assert account.ended.counts["discarded"] > 1


def test_the_same_picture_for_ever_is_no_fresh_frame(tmp_path: Path) -> None:
    """A camera whose driver repeats its last buffer is opened anew, and then the process is."""
    patience = ("gate.enabled=true", "supervision.restarts=2")
    with Ground(numbered=False) as ground:
        still = "test:?pattern=gradient"
        with Flight(tmp_path, ground, None, *SMALL, *patience, camera=still) as flight:
            ended = flight.payload.end(None)
        assert ended.status == HOPELESS, ended.err
        assert "gave no new frame for 1 s" in ended.err and "2 restarts" in ended.err
        assert events_of(ground).count(messages.EVENT_CAMERA_RESTARTED) == 2
        assert messages.EVENT_STREAMING_AGAIN not in events_of(ground)


def test_a_lens_that_is_covered_is_no_camera_that_hangs(tmp_path: Path) -> None:
    dark = ("gate.heartbeat_s=0.2", "gate.enabled=true")
    with streaming(tmp_path, "test:?pattern=black", *dark) as (ground, flight):
        time.sleep(3.0)  # thrice the camera's limit
        flight.finish().ended.assert_in_order()
        assert messages.EVENT_CAMERA_RESTARTED not in events_of(ground)


def test_an_encoder_that_never_comes_back_ends_the_process_for_a_new_one(tmp_path: Path) -> None:
    """What hangs inside a call cannot be closed: status 3, the counters right, and the next."""
    encoder = Shim(tmp_path, "encoder_fault")
    with Ground(numbered=False) as ground:
        with Flight(
            tmp_path / "hangs", ground, None, *SMALL, camera="test:", env=encoder.env
        ) as flight:
            flight.wait_streaming(30)
            encoder.set(DOES_NOT_COME_BACK)
            ended = flight.payload.end(None)
            left = flight.witness.left()
            assert ended.status == HOPELESS, ended.err
            ended.assert_no_accident()
            assert ended.err.startswith("pi_firmware: ") and ended.err.count("\n") == 1
            failed = ground.listener.wait_for_event("blimp-1", messages.EVENT_FAILED, FRESH_S)
            assert failed is not None and failed.values["sent"] == len(left)
            assert [frame.sequence for frame in left] == list(range(len(left)))
        with Flight(tmp_path / "next", ground, None, *SMALL, camera="test:") as successor:
            started_s = time.monotonic()
            while ground.frames[-1].ssrc not in successor.witness.ssrcs():
                assert time.monotonic() - started_s < FRESH_S
                time.sleep(0.02)
            successor.payload.end().assert_in_order()


def test_a_camera_that_is_gone_and_back(
    without_camera: Future[tuple[Account, list[str]]],
) -> None:
    account, events = without_camera.result()
    assert_accounted(account)
    assert messages.EVENT_CAMERA_RESTARTED in events
    assert events.count(messages.EVENT_STREAMING_AGAIN) == 1
    assert messages.EVENT_FAILED not in events
