"""Keys of the payload's file in recorded flights: what leaves the program, or how it ends.

The real program flies two seconds of numbered pictures, as fast as it takes them. No expectation
here is met by the key's default: it would show nothing.
"""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
from numbered_flight import write_flight
from tapped import LIMIT_S, Flown, Tap, fly, start

from ground_station.keys.authority import Authority
from ground_station.stream.telemetry import TelemetryListener

FRAMES = 60


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The URI of a recorded flight."""
    path = tmp_path_factory.mktemp("flights") / "day.mcap"
    return f"replay:{write_flight(path, FRAMES)}?pace=stepped&max_hz=100"


def test_an_idr_follows_a_gap_of_the_configured_length(flight: str) -> None:
    """No frame is rich enough, so that only heartbeats are sent, here each after 0.3 s and more."""
    settings = {"camera.uri": flight, "gate.min_entropy_bits": 8, "gate.heartbeat_s": 0.3}
    flown = fly({**settings, "gate.idr_after_s": 0.2})
    assert len(flown.sequences) >= 4 and flown.idrs == flown.sequences
    flown = fly({**settings, "gate.idr_after_s": 0.6})
    assert len(flown.idrs) < len(flown.sequences) >= 4


def test_an_idr_comes_each_so_many_frames_of_so_many_bits(flight: str) -> None:
    settings = {"camera.uri": flight, "gate.enabled": False}
    usual = fly(settings)
    other = fly({**settings, "encoder.gop_frames": 5, "encoder.bitrate_kbps": 300})

    def longest(flown: Flown) -> int:
        return max(b - a for a, b in itertools.pairwise([*flown.idrs, FRAMES]))

    def kbps(flown: Flown) -> float:
        return sum(len(frame.data) for frame in flown.frames) * 8e-3 / (FRAMES / 30)

    assert usual.sequences == other.sequences == list(range(FRAMES))
    assert longest(other) == 5 < longest(usual)
    assert kbps(other) < 600 < kbps(usual)


def test_a_recording_from_the_start_waits_for_the_first_frame(tmp_path: Path) -> None:
    """What it is written with takes a Pi Zero seconds to load, which the picture would wait for."""
    folder = tmp_path / "card"
    gated = {"gate.min_entropy_bits": 8.0, "gate.heartbeat_s": 0.0}
    recording = {"recording.folder": str(folder), "recording.at_start": True}
    flown = fly({"camera.uri": "test:?duration_s=1", **gated, **recording})
    assert flown.frames == [] and not folder.exists()


def test_telemetry_that_is_off_listens_nowhere(flight: str) -> None:
    settings = {"camera.uri": flight, "telemetry.connect": []}
    settings |= {"telemetry.listen": ["tcp/127.0.0.1:0"]}
    assert "telemetry on" not in fly({**settings, "telemetry.enabled": False}).out


def test_without_a_key_video_leaves_the_machine_only_if_it_may() -> None:
    """Nothing is sent to the address, which is nobody's (RFC 5737): the program ends before."""
    flown = fly({"camera.uri": "test:?duration_s=1", "link.host": "192.0.2.1"})
    assert flown.status == 2 and "video to '192.0.2.1': no SRTP key" in flown.err


def test_with_certificates_it_speaks_tls_and_sends_plain_video_if_told_to(tmp_path: Path) -> None:
    authority = Authority.create(tmp_path / "keys")
    ground = authority.add("ground", "main")
    payload = authority.add("payload", "blimp-1")
    with TelemetryListener(["tls/127.0.0.1:0"], certificates=ground) as listener, Tap() as tap:
        process = start(
            {
                "camera.uri": "test:",
                "link.port": tap.port,
                "link.encrypted": False,
                "telemetry.connect": list(listener.endpoints),
                "telemetry.certificates": str(payload),
            }
        )
        try:
            assert listener.wait(
                "blimp-1", lambda s: s.gate is not None and s.gate.sent > 20, LIMIT_S
            )
        finally:
            process.terminate()
            _, err = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 0, err
    assert tap.frames()
