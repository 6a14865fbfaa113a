"""Keys of the payload's file at the objects that they configure, where no flight shows them.

Each key is loaded as the program loads it and compared with its default at the same object.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from recorded import Events, feed
from scipy.spatial.transform import Rotation
from test_firmware_autopilot_poses import ALONG_X, pose
from test_firmware_battery_monitor import Script, Watched
from waiting import eventually

from pi_firmware import encoder
from pi_firmware.autopilot.poses import PoseGate
from pi_firmware.correction import Sender
from pi_firmware.recording import Recorder
from pi_firmware.settings import Settings, load
from pi_firmware.wire import messages

S = 10**9


def report(**seen: float) -> messages.LinkReport:
    return messages.LinkReport(1, "main", 5600, **seen)  # type: ignore[arg-type]


def kbps_after_a_round_trip_of_0_2_s(settings: Settings) -> int:
    """As an older ground station tells it."""
    made = encoder.Encoder(Mock(), settings.encoder, 30.0)
    made.link_report(report(round_trip_s=0.2))
    return made.bitrate_kbps


def kbps_after_a_queue_of_0_1_s(settings: Settings) -> int:
    made = encoder.Encoder(Mock(), settings.encoder, 30.0)
    made.link_report(report(received_kbps=2000.0, queue_s=0.1, dropped=0.0))
    return made.bitrate_kbps


def frames_to_an_idr_at_a_loss_of_5_percent(settings: Settings) -> int:
    made = encoder.Encoder(Mock(), settings.encoder, 30.0)
    made.link_report(report(lost=0.05))
    return next(count for count in range(100) if made.next_is_due())


def readings(
    settings: Settings,
    count: int,
    voltage: float,
    current: float | None = None,
    *,
    share: Any = None,
) -> list[messages.Battery]:
    """What the monitor says of so many readings, a second apart."""
    reading = {"voltage": voltage, "current": current, "percentage": share}
    watched = Watched(Script(reading), settings.battery)
    watched.steps(count)
    return watched.said


def design_capacity_ah(settings: Settings) -> float | None:
    return readings(settings, 1, 3.8, -0.3)[0].design_capacity


def is_full_at_4_2_volts(settings: Settings) -> bool:
    return (readings(settings, 1, 4.2, 0.0)[0].percentage or 0.0) > 0.99


def charge_under_load(settings: Settings) -> float:
    return readings(settings, 1, 3.6, -0.6)[0].percentage or 0.0


def alarm_at_3_45_volts(settings: Settings) -> str:
    return readings(settings, 10, 3.45, share=0.8)[-1].alarm


def readings_to_the_alarm(settings: Settings) -> int:
    alarms = [reading.alarm for reading in readings(settings, 70, 3.7, share=0.2)]
    return 1 + alarms.index(messages.ALARM_LOW)


def resets(settings: Settings, **moved: Any) -> int:
    """Of an estimate that has moved within 33 ms, in which a blimp turns by 4 degrees at most."""
    gate = PoseGate(settings.autopilot)
    for capture_ns, changes in ((S, {}), (S + 33_000_000, moved)):
        gate.take(pose(capture_ns, **changes), capture_ns)
    return gate.reset_counter


def resets_by_0_4_m(settings: Settings) -> int:
    return resets(settings, x=0.4)


def resets_by_15_degrees(settings: Settings) -> int:
    turned = Rotation.from_euler("z", 15.0, degrees=True) * Rotation.from_quat(ALONG_X)
    return resets(settings, quaternion_xyzw=turned.as_quat().tolist())


@pytest.mark.parametrize(
    ("key", "value", "look", "by_default", "seen"),
    [
        ("encoder.max_round_trip_s", 0.1, kbps_after_a_round_trip_of_0_2_s, 2000, 1700),
        ("encoder.max_queue_s", 0.2, kbps_after_a_queue_of_0_1_s, 1530, 2000),
        ("encoder.min_gop_frames", 4, frames_to_an_idr_at_a_loss_of_5_percent, 10, 4),
        ("battery.capacity_mAh", 1200, design_capacity_ah, 0.6, 1.2),
        ("battery.full_V", 4.35, is_full_at_4_2_volts, True, False),
        ("battery.critical_V", 3.5, alarm_at_3_45_volts, "", "critical"),
        ("battery.confirm_readings", 7, readings_to_the_alarm, 3, 7),
        ("autopilot.jump_m", 0.2, resets_by_0_4_m, 0, 1),
        ("autopilot.jump_deg", 5, resets_by_15_degrees, 0, 1),
    ],
)  # fmt: skip
def test_a_key_is_seen_where_it_is_used(
    key: str, value: object, look: Callable[[Settings], Any], by_default: Any, seen: Any
) -> None:
    assert look(load(None)) == by_default
    assert look(load(None, [f"{key}={value}"])) == seen


@pytest.mark.parametrize("setting", ["battery.resistance_mohm=400", "battery.temperature_C=-10"])
def test_a_cell_of_more_resistance_holds_more_charge_at_the_same_voltage(setting: str) -> None:
    typical, loaded = charge_under_load(load(None)), charge_under_load(load(None, [setting]))
    assert 0.0 < typical < loaded - 0.05


def test_corrections_are_as_many_as_assumed_and_allowed() -> None:
    frame = [struct.pack(">BBHII", 0x80, 96, number, 0, 77) + b"a" for number in range(6)]
    for asked, sent in (
        ([], 0),
        (["link.assumed_loss=0.02"], 3),
        (["link.assumed_loss=0.02", "link.correction=0.3"], 2),
        (["link.assumed_loss=0.02", "link.correction=0"], 0),
    ):
        sender = Sender(load(None, asked).link, 77, sends_again=True)
        assert len([*sender.of(frame)] if sender.wanted else []) == sent


def test_a_recording_is_written_through_as_often_as_configured(tmp_path: Path) -> None:
    """One that has a minute's time has written nothing yet when another has written all."""

    def started(name: str, sync_s: float) -> tuple[Recorder, Path]:
        (tmp_path / name).mkdir()
        given = [f"recording.folder={tmp_path / name}", f"recording.sync_s={sync_s}"]
        settings = load(None, ["recording.min_free_MB=0", *given])
        made = Recorder(settings.recording, Events())
        return made, tmp_path / name / made.start()

    seldom, seldom_path = started("seldom", 60)
    often, often_path = started("often", 0.2)
    head_bytes = seldom_path.stat().st_size
    since_s = time.monotonic()
    for made in (seldom, often):
        feed(made, range(3))
    eventually(lambda: often_path.stat().st_size > 2 * head_bytes)
    eventually(lambda: time.monotonic() - since_s > 1.5)  # twice the default's period
    assert seldom_path.stat().st_size == head_bytes
    often.stop()
    seldom.stop()
    assert seldom_path.stat().st_size > head_bytes
