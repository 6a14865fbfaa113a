"""Keys of the payload's file in recorded flights: what leaves the program, or how it ends.

The real program flies two seconds of numbered pictures, as fast as it takes them. No expectation
here is met by the key's default: it would show nothing.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from pathlib import Path

import pytest
from numbered_flight import write_flight
from tapped import LIMIT_S, Flown, Tap, fly, start

from ground_station.keys.authority import Authority
from ground_station.stream.telemetry import TelemetryListener
from pi_firmware.settings import GateSettings

FRAMES = 60
OPEN_GATE = {"gate.min_entropy_bits": 0, "gate.min_sharpness_ratio": 0, "gate.min_difference": 0}


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """URIs of a flight with a dark stretch, and of one that is all dark."""
    folder = tmp_path_factory.mktemp("flights")

    def recorded(name: str, dark: Iterable[int]) -> str:
        return f"replay:{write_flight(folder / name, FRAMES, dark)}?pace=stepped&max_hz=100"

    return {
        "dusk": recorded("dusk.mcap", range(20, 32)),
        "night": recorded("night.mcap", range(FRAMES)),
    }


@pytest.fixture(scope="module")
def whole(recordings: dict[str, str]) -> Flown:
    """The flight with nothing but its URI configured, and no frame gated."""
    return fly({"camera.uri": recordings["dusk"], "gate.enabled": False})


def test_a_gate_that_is_off_sends_what_it_would_have_dropped(whole: Flown) -> None:
    """The whole flight has gate.enabled = false."""
    least_bits = GateSettings().min_entropy_bits
    poor = [f.info.sequence for f in whole.frames if f.info.entropy_bits < least_bits]
    assert poor == list(range(20, 32))


def test_each_of_the_gates_tests_can_be_left_out(recordings: dict[str, str]) -> None:
    """Without any, dark frames that hardly change are sent, too; each alone drops some frames."""
    settings = {"camera.uri": recordings["dusk"], **OPEN_GATE}
    assert fly(settings).sequences == list(range(FRAMES))
    for key, value in (
        ("gate.min_entropy_bits", 4.0),
        ("gate.min_sharpness_ratio", 1.0),
        ("gate.min_difference", 2.0),
    ):
        assert len(fly({**settings, key: value}).sequences) < FRAMES, key


def test_the_entropys_threshold_and_hysteresis_decide(
    recordings: dict[str, str], whole: Flown
) -> None:
    rich = [frame.info.sequence for frame in whole.frames if frame.info.entropy_bits >= 7.0]
    assert 5 < len(rich) < FRAMES - 5
    settings = {"camera.uri": recordings["dusk"], "gate.min_entropy_bits": 7.0}
    settings |= {"gate.heartbeat_s": 0, "gate.min_difference": 0, "gate.min_sharpness_ratio": 0}
    assert fly({**settings, "gate.hysteresis_bits": 0}).sequences == rich


def test_heartbeats_come_as_often_as_configured(recordings: dict[str, str]) -> None:
    settings = {"camera.uri": recordings["dusk"], "gate.min_entropy_bits": 8}
    flown = fly({**settings, "gate.heartbeat_s": 0.2})
    assert all(frame.info.heartbeat for frame in flown.frames)
    gaps_s = [(b - a) / 30 for a, b in itertools.pairwise(flown.sequences)]
    assert len(gaps_s) >= 6 and min(gaps_s) >= 0.2 - 0.001 and max(gaps_s) < 0.25


def test_an_idr_follows_a_gap_of_the_configured_length(recordings: dict[str, str]) -> None:
    """All is dark, so that only heartbeats are sent: here each after a gap of 0.3 s and more."""
    settings = {"camera.uri": recordings["night"], "gate.heartbeat_s": 0.3}
    flown = fly({**settings, "gate.idr_after_s": 0.2})
    assert len(flown.sequences) >= 4 and flown.idrs == flown.sequences
    flown = fly({**settings, "gate.idr_after_s": 0.6})
    assert len(flown.idrs) < len(flown.sequences) >= 4


def test_an_idr_comes_each_so_many_frames(recordings: dict[str, str], whole: Flown) -> None:
    settings = {"camera.uri": recordings["dusk"], "gate.enabled": False}
    short = fly({**settings, "encoder.gop_frames": 5}).idrs
    assert max(b - a for a, b in itertools.pairwise([*short, FRAMES])) == 5
    assert max(b - a for a, b in itertools.pairwise([*whole.idrs, FRAMES])) > 5


def test_the_encoder_makes_so_many_bits(recordings: dict[str, str], whole: Flown) -> None:
    settings = {"camera.uri": recordings["dusk"], "gate.enabled": False}
    small = fly({**settings, "encoder.bitrate_kbps": 300})

    def kbps(flown: Flown) -> float:
        return sum(len(frame.data) for frame in flown.frames) * 8e-3 / (FRAMES / 30)

    assert kbps(small) < 600 < kbps(whole)


def test_a_recording_from_the_start_waits_for_the_first_frame(tmp_path: Path) -> None:
    """What it is written with takes a Pi Zero seconds to load, which the picture would wait for."""
    folder = tmp_path / "card"
    gated = {"gate.min_entropy_bits": 8.0, "gate.heartbeat_s": 0.0}
    recording = {"recording.folder": str(folder), "recording.at_start": True}
    flown = fly({"camera.uri": "test:?duration_s=1", **gated, **recording})
    assert flown.frames == [] and not folder.exists()


def test_telemetry_that_is_off_listens_nowhere(recordings: dict[str, str]) -> None:
    settings = {"camera.uri": recordings["dusk"], "telemetry.connect": []}
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
