"""The flying program is told what to do, and a dying battery ends it in order."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import pytest
from flying import ALL_FRAMES, Flying, numbers
from vehicle import Vehicle

from ground_station.stream import command as commands
from ground_station.stream.telemetry import PayloadState, TelemetryListener
from pi_firmware import settings
from pi_firmware.commands import actions
from pi_firmware.payload import Payload
from pi_firmware.recording import Recorder
from pi_firmware.wire import messages
from pi_firmware.wire.recording import RecordingReader

LIMIT_S = 30.0
RECORDING = ("recording.min_free_MB=0", "gate.enabled=false")


def ask(flying: Flying, name: str, **numbers: float) -> messages.Answer:
    return commands.ask(flying.listener.session, "blimp-1", name, numbers, LIMIT_S)


def flown(flying: Flying, *settings: str) -> None:
    flying.start("camera.uri=test:", ALL_FRAMES, *settings)
    flying.state(lambda s: s.gate is not None and s.gate.sent > 5)


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Flying]:
    """One that takes orders, each frame of which is accounted for at its end."""
    with ExitStack() as stack:
        made = Flying(stack, tmp_path_factory.mktemp("flight"))
        folder = f"recording.folder={made.folder / 'card'}"
        flown(made, "encoder.min_bitrate_kbps=500", "supervision.period_s=0.2", folder, *RECORDING)
        yield made
        counted = numbers(made.end())
        assert counted["captured"] == counted["sent"] + counted.get("disc", 0)


def test_the_bit_rate_stays_in_its_bounds_and_what_cannot_be_done_is_refused(
    flight: Flying,
) -> None:
    assert ask(flight, "idr").done
    assert ask(flight, "bitrate", kbps=800).values == {"kbps": 800}
    flight.state(lambda s: s.health is not None and s.health.bitrate_kbps == 800)
    assert ask(flight, "bitrate", kbps=100).values == {"kbps": 500}
    assert ask(flight, "bitrate", kbps=9000).values == {"kbps": 2000}
    refused = ask(flight, "bitrate", kbps=1e9)
    assert not refused.done and "allowed: 50 to 20000" in refused.reason
    state = flight.has(messages.EVENT_COMMAND)
    assert any(e.text == "bitrate: done" for e in state.events)
    for name, reason in (
        ("fly", "no command 'fly'"),
        ("shutdown", "'battery.shutdown_command' is empty"),
        ("reboot", "'supervision.reboot_command' is empty"),
    ):
        refused = ask(flight, name)
        assert not refused.done and reason in refused.reason


def test_exposure_is_set_anew_or_left_as_it_was(flight: Flying) -> None:
    assert ask(flight, "exposure", exposure_s=0.01, gain=2).values == {
        "exposure_s": 0.01,
        "gain": 2.0,
    }
    frame = until_exposed(flight, 0.01)
    assert frame == pytest.approx((0.01, 2.0))
    refused = ask(flight, "exposure", exposure_s=0.5)
    assert not refused.done and "camera.exposure_s is 0.5" in refused.reason
    sent = flight.listener.state("blimp-1").gate.sent  # type: ignore[union-attr]
    flight.state(lambda s: s.gate is not None and s.gate.sent > sent + 30)
    assert until_exposed(flight, 0.01) == pytest.approx((0.01, 2.0))


def until_exposed(flying: Flying, exposure_s: float) -> tuple[float | None, float | None]:
    """Exposure and gain of the first frame that tells this exposure."""
    while (frame := flying.receiver.get(LIMIT_S)) is not None:
        if frame.exposure_s is not None and abs(frame.exposure_s - exposure_s) < 1e-6:
            return frame.exposure_s, frame.gain
    raise AssertionError("no frame with that exposure came")


def test_a_recording_is_made_from_command_to_command(flight: Flying) -> None:
    assert ask(flight, "record-stop").reason == "nothing was recorded"
    assert ask(flight, "record-start").done
    state = flight.has(messages.EVENT_RECORDING_STARTED)
    began = state.frames.sent if state.frames else 0
    flight.state(lambda s: s.gate is not None and s.gate.sent > began + 60)
    assert ask(flight, "record-stop").done
    flight.has(messages.EVENT_RECORDING_ENDED)
    (path,) = (flight.folder / "card").glob("*.mcap")
    reader = RecordingReader(path)
    assert len(list(reader.video())) >= 50 and not reader.cut
    assert "/blimp/gate" in reader.topics()


def test_a_card_that_takes_no_recording_ends_no_flight(flying: Flying, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    flown(flying, f"recording.folder={tmp_path / 'file'}", "recording.at_start=true", *RECORDING)
    state = flying.has(messages.EVENT_RECORDING_ENDED)
    sent = state.gate.sent if state.gate else 0
    flying.state(lambda s: s.gate is not None and s.gate.sent > sent + 10)
    flying.end()


def test_a_reboot_and_a_shutdown_run_what_each_is_configured_to() -> None:
    told: list[list[str]] = []
    given = settings.load(
        None, ['battery.shutdown_command=["off"]', 'supervision.reboot_command=["again"]']
    )
    made = actions(given, Mock(), Mock(), told.append, lambda: False)
    for name in ("reboot", "shutdown"):
        made[name].run()
    assert told == [["again"], ["off"]]


def test_the_board_ends_by_command_after_all_else(flying: Flying, tmp_path: Path) -> None:
    card, seen = tmp_path / "card", tmp_path / "seen"
    command = ["cp", "-r", str(card), str(seen)]
    flown(
        flying,
        f"supervision.reboot_command={json.dumps(command)}",
        f"recording.folder={card}",
        "recording.at_start=true",
        *RECORDING,
    )
    flying.state(lambda s: s.gate is not None and s.gate.sent > 40)
    assert ask(flying, "reboot").done
    assert flying.process is not None
    flying.process.wait(LIMIT_S)
    flying.end()
    (path,) = seen.glob("*.mcap")  # whole already when the command ran
    reader = RecordingReader(path)
    assert len(list(reader.video())) >= 30 and not reader.cut


def test_an_armed_vehicle_keeps_its_video_unless_forced(flying: Flying, tmp_path: Path) -> None:
    vehicle = Vehicle(tmp_path / "tty")

    def says(state: PayloadState, *, armed: bool) -> bool:
        vehicle.live(armed)
        return state.autopilot is not None and state.autopilot.armed is armed

    flown(
        flying,
        f"autopilot.uri=serial:{vehicle.link}",
        "autopilot.period_s=0.1",
        "supervision.period_s=0.2",
        'battery.shutdown_command=["true"]',
        'supervision.reboot_command=["true"]',
    )
    flying.state(partial(says, armed=True))
    for name, given in (("shutdown", {}), ("reboot", {"force": 0}), ("exposure", {"gain": 2})):
        refused = ask(flying, name, **given)
        assert not refused.done and "armed: disarm it, or say force=1" in refused.reason
    assert ask(flying, "exposure", gain=2, force=1).values["forced"] == 1
    flying.state(lambda s: any(e.text == "exposure: done, forced" for e in s.events))
    # What an update looks for.
    flying.state(lambda s: any("autopilot armed" in line for line in flying.said()))
    flying.state(partial(says, armed=False))
    assert "forced" not in ask(flying, "exposure", gain=1).values
    flying.end()
    vehicle.unplug()


def test_a_critical_battery_ends_recording_and_flight_and_then_the_board(
    flying: Flying, tmp_path: Path
) -> None:
    card, mark = tmp_path / "card", tmp_path / "off"
    command = ["sh", "-c", f"ls {card} > {mark}"]
    flying.start(
        "camera.uri=test:",
        "battery.uri=fake:?percentage=0.3",
        "battery.low_percentage=0.45",
        "battery.critical_percentage=0.4",
        "battery.period_s=0.5",
        f"battery.shutdown_command={json.dumps(command)}",
        f"recording.folder={card}",
        "recording.at_start=true",
        *RECORDING,
    )
    assert flying.process is not None
    flying.process.wait(LIMIT_S)
    counted = numbers(flying.end())
    assert counted["captured"] == counted["sent"] + counted.get("disc", 0)
    state = flying.has(messages.EVENT_STOPPED)
    names = [event.name for event in state.events]
    ended = names.index(messages.EVENT_RECORDING_ENDED)
    assert names.index(messages.EVENT_BATTERY_CRITICAL) < names.index(messages.EVENT_STOPPED)
    assert ended < names.index(messages.EVENT_STOPPED)
    assert mark.read_text().split() == [path.name for path in card.iterdir()]
    (path,) = card.glob("*.mcap")
    reader = RecordingReader(path)
    assert list(reader.video()) and not reader.cut


def test_what_ended_the_flight_is_told_before_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    closed = Recorder.close

    def slowly(recorder: Recorder) -> None:
        time.sleep(1.0)  # a card that takes its time, longer than the encoder takes to end
        closed(recorder)

    monkeypatch.setattr(Recorder, "close", slowly)
    with TelemetryListener(["tcp/127.0.0.1:0"]) as listener:
        payload = Payload(
            settings.load(
                None,
                [
                    "camera.uri=test:",
                    f"telemetry.connect={json.dumps(listener.endpoints)}",
                    "battery.uri=fake:?percentage=0.02",
                    "battery.period_s=0.1",
                    "battery.shutdown_command=[]",
                ],
            )
        )
        try:
            payload.run(threading.Event())
        finally:
            payload.close()
        ended = messages.EVENT_STOPPED
        state = listener.wait("blimp-1", lambda s: any(e.name == ended for e in s.events), LIMIT_S)
    assert state is not None
    names = [event.name for event in state.events]
    assert names.index(messages.EVENT_BATTERY_CRITICAL) < names.index(ended)
