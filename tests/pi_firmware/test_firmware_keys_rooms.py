"""Keys of the payload's file at the objects that they configure, where no flight shows them.

Each key is loaded as the program loads it and compared with its default at the same object.
"""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from recorded import Events, feed, files
from scipy.spatial.transform import Rotation
from waiting import eventually

from pi_firmware import encoder
from pi_firmware.autopilot.poses import PoseGate
from pi_firmware.battery import Monitor
from pi_firmware.battery.chip import Counts
from pi_firmware.correction import Sender
from pi_firmware.health.wifi import Wifi
from pi_firmware.recording import Recorder
from pi_firmware.settings import Settings, load
from pi_firmware.sources.schemes import libcamera, v4l2
from pi_firmware.wire import messages
from pi_firmware.wire.errors import RecordingError

S = 10**9
AHEAD = Rotation.from_quat([-0.5, 0.5, -0.5, 0.5])
"""A camera that looks along the map's x axis, upright."""


def asked_of_libcamera(settings: Settings) -> dict[str, Any]:
    return {name: asked.value for name, asked in libcamera.controls(settings.camera).items()}


def set_on_v4l2(settings: Settings) -> dict[int, int]:
    """What a device that has every control holds after all wishes were applied."""
    held: dict[int, int] = {}

    def ioctl(file: int, request: int, data: bytearray) -> None:
        control = int.from_bytes(data[:4], "little")
        if request == v4l2.VIDIOC_QUERYCTRL:
            data[:] = v4l2._QUERYCTRL.pack(control, 0, b"", 0, 100_000, 1, 0, 0)
        elif request == v4l2.VIDIOC_S_CTRL:
            held[control] = v4l2._CONTROL.unpack(data)[1]
        else:
            data[:] = v4l2._CONTROL.pack(control, held[control])

    assert [v4l2.apply(wish, 0, ioctl) for wish in v4l2.control_requests(settings.camera, None)]
    return {control: value for control, value in held.items() if control != 0x009A0903}


class Element:
    """Where the encoder's GStreamer element would be."""

    bitrate = 2000

    def set_property(self, name: str, value: int) -> None:
        setattr(self, name, value)


def encoder_element(settings: Settings) -> str:
    return encoder.description(settings.encoder, settings.camera, 30.0).split()[0]


def report(**seen: float) -> messages.LinkReport:
    return messages.LinkReport(1, "main", 5600, **seen)  # type: ignore[arg-type]


def kbps_after_a_round_trip_of_0_2_s(settings: Settings) -> int:
    """As an older ground station tells it."""
    element = Element()
    encoder.Encoder(element, settings.encoder, 30.0).link_report(report(round_trip_s=0.2))
    return element.bitrate


def kbps_after_a_queue_of_0_1_s(settings: Settings) -> int:
    element = Element()
    made = encoder.Encoder(element, settings.encoder, 30.0)
    made.link_report(report(received_kbps=2000.0, queue_s=0.1, dropped=0.0))
    return element.bitrate


def frames_to_an_idr_at_a_loss_of_5_percent(settings: Settings) -> int:
    made = encoder.Encoder(Element(), settings.encoder, 30.0)
    made.link_report(report(lost=0.05))
    return next(count for count in range(100) if made.next_is_due())


class Gauge:
    """A gauge that always gives the same."""

    def __init__(self, voltage: float, current: float | None, percentage: float | None) -> None:
        self.counts = Counts()
        self._values = {"voltage": voltage, "current": current, "percentage": percentage}

    def read(self, time_ns: int) -> messages.Battery:
        return messages.Battery(time_ns=time_ns, power_supply_status=2, **self._values)  # type: ignore[arg-type]

    def close(self) -> None:
        pass


def readings(
    settings: Settings,
    count: int,
    voltage: float,
    current: float | None = None,
    *,
    share: Any = None,
) -> list[messages.Battery]:
    """What the monitor says of so many readings, a second apart."""
    said: list[messages.Battery] = []
    monitor = Monitor(
        settings.battery,
        Gauge(voltage, current, share),
        publish=said.append,
        announce=lambda name, text: None,
        clock=lambda: float(len(said)),
    )
    for second in range(count):
        monitor.step(second * S)
    return said


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


def pose(
    capture_ns: int, position_m: tuple[float, float, float] = (1, 2, 3), turned_deg: float = 0.0
) -> messages.Pose:
    wRc = Rotation.from_euler("z", turned_deg, degrees=True) * AHEAD
    return messages.Pose(
        time_ns=1, capture_ns=capture_ns, sequence=0, state="TRACKING",
        position_m=list(position_m), quaternion_xyzw=wRc.as_quat().tolist(),
    )  # fmt: skip


def vehicle(settings: Settings) -> Any:
    """Roll, pitch and yaw in degrees, then north, east and down in metres."""
    taken = PoseGate(settings.autopilot).take(pose(S), S)
    assert taken is not None
    values = [*map(math.degrees, taken.angles_rad), *taken.position_m]
    return pytest.approx(values, abs=1e-6)


def is_sent_after_0_8_s(settings: Settings) -> bool:
    return PoseGate(settings.autopilot).take(pose(S), S + 800_000_000) is not None


def resets(settings: Settings, **moved: Any) -> int:
    """Of an estimate that has moved within 33 ms, in which a blimp turns by 4 degrees at most."""
    gate = PoseGate(settings.autopilot)
    gate.take(pose(S), S)
    later_ns = S + 33_000_000
    gate.take(pose(later_ns, **moved), later_ns)
    return gate.reset_counter


def resets_by_0_4_m(settings: Settings) -> int:
    return resets(settings, position_m=(1.4, 2, 3))


def resets_by_15_degrees(settings: Settings) -> int:
    return resets(settings, turned_deg=15.0)


DEGREES_AND_PLACE = [0, 0, 0, 1, -2, -3]
"""North is the map's x axis, east against its y, down against its z."""


@pytest.mark.parametrize(
    ("key", "value", "look", "by_default", "seen"),
    [
        ("camera.exposure_s", 0.01, asked_of_libcamera, {},
         {"exposure-time-mode": "manual", "exposure-time": 10_000}),
        ("camera.gain", 4, asked_of_libcamera, {},
         {"analogue-gain-mode": "manual", "analogue-gain": 4.0}),
        ("camera.white_balance", "cloudy", asked_of_libcamera, {}, {"awb-mode": "cloudy"}),
        ("camera.focus_m", 4, asked_of_libcamera, {}, {"af-mode": "manual", "lens-position": 0.25}),
        ("camera.exposure_s", 0.01, set_on_v4l2, {}, {0x009A0901: 1, 0x009A0902: 100}),
        ("camera.gain", 4, set_on_v4l2, {}, {0x00980912: 0, 0x00980913: 4}),
        ("camera.white_balance", "cloudy", set_on_v4l2, {}, {0x0098090C: 0, 0x0098091A: 6500}),
        ("encoder.name", "v4l2h264enc", encoder_element, "x264enc", "v4l2h264enc"),
        ("encoder.max_round_trip_s", 0.1, kbps_after_a_round_trip_of_0_2_s, 2000, 1700),
        ("encoder.max_queue_s", 0.2, kbps_after_a_queue_of_0_1_s, 1530, 2000),
        ("encoder.min_gop_frames", 4, frames_to_an_idr_at_a_loss_of_5_percent, 10, 4),
        ("battery.capacity_mAh", 1200, design_capacity_ah, 0.6, 1.2),
        ("battery.full_V", 4.35, is_full_at_4_2_volts, True, False),
        ("battery.critical_V", 3.5, alarm_at_3_45_volts, "", "critical"),
        ("battery.confirm_readings", 7, readings_to_the_alarm, 3, 7),
        ("autopilot.max_age_s", 1, is_sent_after_0_8_s, False, True),
        ("autopilot.world_heading_deg", 90, vehicle, DEGREES_AND_PLACE, [0, 0, 90, 2, 1, -3]),
        ("autopilot.mount_roll_deg", 20, vehicle, DEGREES_AND_PLACE, [-20, 0, 0, 1, -2, -3]),
        ("autopilot.mount_pitch_deg", -30, vehicle, DEGREES_AND_PLACE, [0, 30, 0, 1, -2, -3]),
        ("autopilot.mount_yaw_deg", 90, vehicle, DEGREES_AND_PLACE, [0, 0, -90, 1, -2, -3]),
        ("autopilot.mount_m", [0.5, 0.1, 0.2], vehicle, DEGREES_AND_PLACE,
         [0, 0, 0, 0.5, -2.1, -3.2]),
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


@pytest.mark.parametrize("restart_after_s", [5, 40])
def test_a_radio_is_restarted_after_so_long_a_silence(restart_after_s: int, tmp_path: Path) -> None:
    folder = tmp_path / "sys/class/net/wlan0"
    (folder / "wireless").mkdir(parents=True)
    ran: list[str] = []
    now_s = 0.0

    def run(words: list[str]) -> str:
        ran.append(" ".join(words))
        return "Power save: off\n"

    settings = load(None, ["wifi.interface=wlan0", f"wifi.restart_after_s={restart_after_s}"])
    wifi = Wifi(
        settings.wifi,
        lambda name, text: None,
        root=tmp_path,
        run=run,
        clock=lambda: now_s,
        off_s=0.0,
    )
    wifi.heard()
    while "ip link set dev wlan0 down" not in ran and now_s < 100:
        now_s += 1.0
        wifi.look()
    assert restart_after_s <= now_s <= restart_after_s + 1
    assert "iw dev wlan0 set power_save off" in ran


def recorder(folder: Path, *given: str) -> Recorder:
    more = [f"recording.folder={folder}", *given]
    return Recorder(load(None, ["recording.min_free_MB=0", *more]).recording, Events())


@pytest.mark.parametrize(("max_file_MB", "count"), [(1, 2), (2, 1)])
def test_a_recordings_file_ends_at_its_size(max_file_MB: int, count: int, tmp_path: Path) -> None:
    made = recorder(tmp_path, f"recording.max_file_MB={max_file_MB}")
    made.start()
    feed(made, range(100), 15_000)
    made.stop()
    assert len(files(tmp_path)) == count


def test_old_recordings_go_when_all_are_too_large(tmp_path: Path) -> None:
    for total, stays in (("3", True), ("2", False)):
        folder = tmp_path / total
        folder.mkdir()
        (folder / "flight-000001.mcap").write_bytes(b"x" * 1_500_000)
        made = recorder(folder, f"recording.max_total_MB={total}")
        made.start()
        feed(made, range(50), 15_000)
        made.stop()
        assert (folder / "flight-000001.mcap").exists() is stays


def test_nothing_is_recorded_where_too_little_is_free(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"recording\.min_free_MB is 1000000$"):
        recorder(tmp_path, "recording.min_free_MB=1000000").start()


def test_a_recording_is_written_through_as_often_as_configured(tmp_path: Path) -> None:
    """One that has a minute's time has written nothing yet when another has written all."""
    often = recorder(tmp_path / "often", "recording.sync_s=0.2")
    seldom = recorder(tmp_path / "seldom", "recording.sync_s=60")
    (tmp_path / "often").mkdir()
    (tmp_path / "seldom").mkdir()
    seldom.start()
    often.start()
    (seldom_path,), (often_path,) = files(tmp_path / "seldom"), files(tmp_path / "often")
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
