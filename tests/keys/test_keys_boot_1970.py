"""A board without a clock boots in 1970: its real program speaks mutual TLS and is exact."""

import datetime
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from firmware_program import LIMIT_S, Program
from receiving import Receiver
from short_certificates import certify

from ground_station.keys import certificates
from ground_station.keys.authority import Authority
from ground_station.stream.assembly import ReceivedFrame
from ground_station.stream.srtp import load_keys
from ground_station.stream.telemetry import TelemetryListener

SHIM = Path(__file__).with_name("system_clock.c")
PATIENCE_S = 6.0
FRAMES = 30
YEAR_NS = 365 * 24 * 3600 * 10**9


@pytest.fixture(scope="module")
def in_1970(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment of a process whose system clock started at the epoch a minute ago."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler (cc) to make a shifted system clock with")
    library = tmp_path_factory.mktemp("clock") / "system_clock.so"
    built = subprocess.run(
        [compiler, "-shared", "-fPIC", "-O1", "-o", str(library), str(SHIM)],
        capture_output=True, text=True,
    )  # fmt: skip
    if built.returncode:
        pytest.skip(f"cc cannot make a shared library here: {built.stderr.strip()[:100]}")
    behind_s = int(time.time()) - 60
    shifted = {**os.environ, "LD_PRELOAD": str(library), "CLOCK_BEHIND_S": str(behind_s)}
    tried = subprocess.run(
        [sys.executable, "-c", "import time; print(time.gmtime().tm_year)"],
        env=shifted, capture_output=True, text=True,
    )  # fmt: skip
    if tried.stdout.strip() != "1970":
        pytest.skip("LD_PRELOAD has no effect here")
    return shifted


@pytest.fixture
def listener(authority: Authority) -> Iterator[TelemetryListener]:
    with TelemetryListener(["tls/127.0.0.1:0"], certificates=authority.of("ground.main")) as opened:
        yield opened


def test_a_board_in_1970_comes_up_with_mutual_tls_and_exact_latencies(
    in_1970: dict[str, str], authority: Authority, listener: TelemetryListener
) -> None:
    keys = load_keys(authority.of("ground.main"))
    own = authority.of("payload.blimp-1")
    with (
        Receiver(0, queue_frames=FRAMES, srtp_keys=keys) as receiver,
        Program(own, listener.endpoints, receiver.port, in_1970),
    ):
        assert listener.wait("blimp-1", lambda s: s.alive and s.ssrc is not None, LIMIT_S)
        deadline = time.monotonic() + LIMIT_S
        while listener.clock("blimp-1") is None and time.monotonic() < deadline:
            time.sleep(0.02)
        frames: list[ReceivedFrame] = []
        while len(frames) < FRAMES and time.monotonic() < deadline:
            if (frame := receiver.get(0.1)) is not None:
                frames.append(frame)
        offset = listener.clock("blimp-1")
        state = listener.state("blimp-1")
    assert len(frames) == FRAMES and offset is not None and offset.steps == 0
    assert state is not None and state.ssrc == frames[0].ssrc
    assert offset.offset_ns < -50 * YEAR_NS and offset.uncertainty_ns < 10**9
    for frame in frames:
        assert 0 < frame.clock_ns < YEAR_NS
        # It was captured before it came, and not long before: both are our own clock's now.
        late_ns = frame.arrival_ns - offset.to_ours(frame.clock_ns)
        assert -offset.uncertainty_ns <= late_ns < 10 * 10**9


def test_the_shifted_clock_is_the_one_that_certificates_are_judged_by(
    in_1970: dict[str, str],
    authority: Authority,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Otherwise the test above would show nothing: here one of this century is refused in 1970."""
    monkeypatch.setattr(
        certificates, "VALID_FROM", datetime.datetime(2000, 1, 1, tzinfo=datetime.UTC)
    )
    late = certify(authority, "ground.main", tmp_path / "late", datetime.timedelta(days=9))
    own = authority.of("payload.blimp-1")
    cases = ((None, True, LIMIT_S), (in_1970, False, PATIENCE_S))
    for environment, expected, wait_s in cases:
        with (
            TelemetryListener(["tls/127.0.0.1:0"], certificates=late) as listener,
            Program(own, listener.endpoints, environment=environment),
        ):
            alive = listener.wait("blimp-1", lambda s: s.alive, wait_s)
            assert (alive is not None) is expected
