"""The real program hangs in various places: frames come again, or the process says it cannot."""

from __future__ import annotations

import json
import time
from pathlib import Path

from flying import ALL_FRAMES, Flying, numbers

from pi_firmware import settings, supervision
from pi_firmware.wire import messages


def test_systemd_is_fed_with_fresh_frames_and_no_task_is_late(flying: Flying) -> None:
    flying.start("camera.uri=test:", "supervision.period_s=0.2")
    for sent in (5, 30):
        state = flying.state(lambda s, n=sent: s.health is not None and s.health.sent > n)
        health = state.health
        assert health is not None and health.late == []
        assert health.memory_MB is not None and health.memory_MB > 5
    assert health.rate_hz > 0 and health.cpu is not None
    names = [*supervision.tasks(settings.Settings())]
    assert names == ["video", "battery", "autopilot", "health", "clock", "memory"]
    said = flying.said()
    assert said[0] == "READY=1" and said.count("READY=1") == 1
    assert said.count("WATCHDOG=1") >= 1
    flying.end()
    assert flying.said()[-1] == "STOPPING=1"


def test_systemd_is_fed_no_more_when_frames_no_longer_leave_the_encoder(flying: Flying) -> None:
    flying.start("camera.uri=test:", ALL_FRAMES, "supervision.frame_timeout_s=14", stall=(10, 1))
    flying.state(lambda s: s.gate is not None and s.gate.sent >= 10)
    time.sleep(1.0)
    flying.said()
    time.sleep(2.0)
    assert flying.said() == []  # although camera, gate and telemetry work on
    assert flying.process is not None and flying.process.poll() is None
    flying.process.kill()


def test_an_encoder_that_stalls_is_started_anew_and_no_frame_is_lost_count_of(
    flying: Flying,
) -> None:
    flying.start("camera.uri=test:", ALL_FRAMES, "supervision.frame_timeout_s=1", stall=(20, 1))
    state = flying.has(messages.EVENT_STREAMING_AGAIN)
    names = [event.name for event in state.events]
    assert names.count(messages.EVENT_ENCODER_RESTARTED) == 1
    assert messages.EVENT_CAMERA_RESTARTED not in names
    sent = state.frames.sent if state.frames else 0
    flying.state(lambda s: s.frames is not None and s.frames.sent > sent + 30)
    health = flying.state(lambda s: s.health is not None and s.health.encoder_restarts == 1)
    assert health.health is not None and health.health.late == []
    counted = numbers(flying.end())
    assert counted["captured"] == counted["gated"] + counted["sent"] + counted["disc"]
    assert counted["disc"] >= 1
    last = flying.receiver.counters
    assert last.packets_lost == 0  # RTP goes on where it was
    assert last.decoded == counted["sent"]


def test_a_process_that_cannot_help_itself_ends_and_the_next_reboots_the_board(
    flying: Flying, tmp_path: Path
) -> None:
    mark = tmp_path / "rebooted"
    given = (
        "camera.uri=test:",
        "supervision.frame_timeout_s=0.5",
        "supervision.restarts=1",
        "supervision.process_restarts=2",
        f"supervision.state={tmp_path / 'restarts.json'}",
        f"supervision.reboot_command={json.dumps(['touch', str(mark)])}",
    )
    for process in range(2):
        assert not mark.exists()
        flying.start(*given, stall=(0, 99))
        err = flying.end(status=3)
        assert err.count("\n") == 1 and "1 restarts of camera and encoder did not help" in err
        assert mark.exists() is (process == 1)
    assert "READY=1" not in flying.said()
