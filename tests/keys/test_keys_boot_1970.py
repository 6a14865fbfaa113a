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
from receiving import Receiver

from ground_station.keys import certificates
from ground_station.keys.authority import Authority
from ground_station.stream.assembly import ReceivedFrame
from ground_station.stream.srtp import load_keys
from ground_station.stream.telemetry import TelemetryListener

SHIM = Path(__file__).with_name("system_clock.c")
LIMIT_S = 60.0
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
def authority(tmp_path: Path) -> Authority:
    made = Authority.create(tmp_path / "keys")
    made.add("ground", "main")
    made.add("payload", "blimp-1")
    return made


@pytest.fixture
def listener(authority: Authority) -> Iterator[TelemetryListener]:
    with TelemetryListener(["tls/127.0.0.1:0"], certificates=authority.of("ground.main")) as opened:
        yield opened


class Program:
    """The payload's program with its certificates; a context manager that ends it."""

    def __init__(self, environment: dict[str, str], folder: Path, endpoint: str, port: int) -> None:
        settings = (
            "camera.uri=test:", "camera.width_px=320", "camera.height_px=240",
            "camera.rate_hz=15", f"link.port={port}", f"telemetry.certificates={folder}",
            f'telemetry.connect=["{endpoint}"]', "wifi.interface=",
        )  # fmt: skip
        overrides = [part for setting in settings for part in ("--set", setting)]
        self._command = [sys.executable, "-m", "pi_firmware", *overrides]
        self._environment = environment

    def __enter__(self) -> "Program":
        self._process = subprocess.Popen(
            self._command, env=self._environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )
        return self

    def __exit__(self, *_: object) -> None:
        self._process.terminate()
        try:
            self._process.communicate(timeout=LIMIT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.communicate()


def test_a_board_in_1970_comes_up_with_mutual_tls_and_exact_latencies(
    in_1970: dict[str, str], authority: Authority, listener: TelemetryListener
) -> None:
    keys = load_keys(authority.of("ground.main"))
    own = authority.of("payload.blimp-1")
    with (
        Receiver(0, queue_frames=FRAMES, srtp_keys=keys) as receiver,
        Program(in_1970, own, listener.endpoints[0], receiver.port),
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
    late = Path(shutil.copytree(authority.of("ground.main"), tmp_path / "late"))
    signer = authority.folder / "authorities"
    pair = certificates.make_certificate(
        "ground.main",
        certificates.Pair((signer / "1.pem").read_bytes(), (signer / "1.key").read_bytes()),
        datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=9),
    )
    (late / "certificate.pem").write_bytes(pair.certificate)
    (late / "key.pem").write_bytes(pair.key)
    own = authority.of("payload.blimp-1")
    cases = ((dict(os.environ), True, LIMIT_S), (in_1970, False, PATIENCE_S))
    for environment, expected, wait_s in cases:
        with (
            TelemetryListener(["tls/127.0.0.1:0"], certificates=late) as listener,
            Program(environment, own, listener.endpoints[0], port=9),
        ):
            alive = listener.wait("blimp-1", lambda s: s.alive, wait_s)
            assert (alive is not None) is expected
