"""The autopilot's line over a pseudo-terminal, with a second MAVLink endpoint at its end."""

import contextlib
import math
import os
import select
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink
from vehicle import Vehicle
from waiting import eventually

from pi_firmware import autopilot
from pi_firmware.settings import AutopilotSettings
from pi_firmware.wire import messages
from pi_firmware.wire.errors import SourceError

LEVEL = [-0.5, 0.5, -0.5, 0.5]  # the camera looks along the map's x axis
LIMIT_S = 20.0


@pytest.fixture
def vehicle(tmp_path: Path) -> Iterator[Vehicle]:
    made = Vehicle(tmp_path / "tty")
    yield made
    os.close(made.master)


class Pilot:
    """The payload's side, with all the states it told."""

    def __init__(
        self, vehicle: Vehicle, publish: Callable[..., None] | None = None, period_s: float = 0.1
    ) -> None:
        self.vehicle = vehicle
        self.told: list[messages.Autopilot] = []
        settings = AutopilotSettings(uri=f"serial:{vehicle.link}?baud=921600", period_s=period_s)
        self.autopilot = autopilot.open_autopilot(settings, publish or self.told.append)

    def pose(self, x: float, age_ns: int = 0, **changes: Any) -> None:
        now_ns = time.time_ns()
        values = {
            "state": "TRACKING",
            "position_m": [x, 2.0, 3.0],
            "quaternion_xyzw": LEVEL,
            "covariance": [0.01 if i % 7 == 0 else 0.0 for i in range(36)],
        } | changes
        self.autopilot.on_pose(
            messages.Pose(time_ns=now_ns, capture_ns=now_ns - age_ns, sequence=0, **values)
        )

    def poses_until(self, condition: Callable[[], Any], **changes: Any) -> None:
        """Gives one pose after the other until the condition holds."""

        def give() -> None:
            self.pose(1.0, **changes)
            self.vehicle.listen()

        eventually(condition, step=give)


@pytest.fixture
def pilot(vehicle: Vehicle) -> Iterator[Pilot]:
    made = Pilot(vehicle)
    made.autopilot.start()
    yield made
    made.autopilot.stop()


def test_poses_arrive_in_ned_with_covariance_and_reset_counter(
    vehicle: Vehicle, pilot: Pilot
) -> None:
    pilot.poses_until(vehicle.estimates)
    first = vehicle.estimates()[0]
    assert (first.x, first.y, first.z) == pytest.approx((1, -2, -3))
    assert (first.roll, first.pitch, first.yaw) == pytest.approx((0, 0, 0), abs=1e-6)
    assert len(first.covariance) == 21
    diagonal = [first.covariance[i] for i in (0, 6, 11, 15, 18, 20)]
    assert diagonal == pytest.approx([0.01] * 6, rel=1e-5)
    assert first.reset_counter == 0
    assert abs(first.usec / 1e6 - time.time()) < LIMIT_S
    assert first.get_srcComponent() == 197
    assert vehicle.heard[0].get_type() == "HEARTBEAT"  # it says that it is there before all else
    pilot.poses_until(lambda: vehicle.estimates()[-1].reset_counter >= 1, relocalized=True)


def x25(data: bytes) -> int:
    """MAVLink's checksum, CRC-16/MCRF4XX."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x8408 if crc & 1 else 0)
    return crc


def test_a_pose_with_velocity_is_an_odometry_byte_by_byte(vehicle: Vehicle, pilot: Pilot) -> None:
    data = b""
    # It flies along the map's y, to the left of where it looks, and yaws to the left.
    motion = {"velocity_mps": [0.0, 0.7, 0.0], "turn_radps": [0.0, -0.2, 0.0], "quality": 0.836}

    def give() -> None:
        nonlocal data
        pilot.pose(1.0, **motion)
        if select.select([vehicle.master], [], [], 0.02)[0]:
            with contextlib.suppress(OSError):  # nobody has the other end open yet
                data += os.read(vehicle.master, 4096)

    head = b"\x4b\x01\x00"  # message 331
    eventually(lambda: head in data and len(data) - data.index(head) > 300, step=give)
    frame = data[data.index(head) - 7 :]
    magic, length, _, _, _, system, component = frame[:7]
    assert (magic, system, component) == (0xFD, 1, 197)
    extra = 91  # of its fields' names and types, in MAVLink's definition
    assert x25(frame[1 : 10 + length] + bytes([extra])) == int.from_bytes(
        frame[10 + length : 12 + length], "little"
    )
    fields = struct.Struct("<Q3f4f3f3f21f21fBBBBb")
    payload = frame[10 : 10 + length].ljust(fields.size, b"\0")  # zeros at its end are not sent
    usec, *values = fields.unpack(payload)
    assert abs(usec / 1e6 - time.time()) < LIMIT_S
    assert values[:3] == [1, -2, -3]
    assert values[3:7] == pytest.approx([1, 0, 0, 0], abs=1e-6)
    assert values[7:13] == pytest.approx([0, -0.7, 0, 0, 0, -0.2], abs=1e-6)  # body's axes
    assert [values[13 + k] for k in (0, 6, 11, 15, 18, 20)] == pytest.approx([0.01] * 6)
    assert math.isnan(values[34]) and values[35:55] == [0] * 20
    # LOCAL_FRD, BODY_FRD, resets, vision, percent
    assert values[55:] == [20, 12, 0, 2, 84]


def test_stale_and_lost_poses_never_arrive(vehicle: Vehicle, pilot: Pilot) -> None:
    count = 0

    def give() -> None:
        nonlocal count
        count += 1
        pilot.pose(50.0, age_ns=2 * 10**9) if count % 2 else pilot.pose(60.0, state="LOST")
        vehicle.listen()

    eventually(
        lambda: pilot.told and pilot.told[-1].stale > 3 and pilot.told[-1].lost > 3, step=give
    )
    pilot.poses_until(vehicle.estimates)
    assert {m.x for m in vehicle.estimates()} == {1.0}


def test_its_heartbeat_attitude_and_battery_come_back(vehicle: Vehicle, pilot: Pilot) -> None:
    os.write(vehicle.master, b"\xfd\x00garbage\xfe\xff" * 20)  # noise before and between

    turns = 0

    def live() -> None:
        nonlocal turns
        turns += 1
        vehicle.live()
        if turns % 10 == 1:  # a false start of 255 bytes swallows what follows, and no more
            os.write(vehicle.master, b"\xfd\xff\x00")
        vehicle.listen()

    eventually(lambda: pilot.told and pilot.told[-1].battery_V, step=live)
    state = pilot.told[-1]
    assert state.connected and state.heartbeats > 0
    assert state.armed is True and state.mode == 5
    assert state.system_status == mavlink.MAV_STATE_ACTIVE
    angles = (state.roll_rad, state.pitch_rad, state.yaw_rad)
    assert angles == pytest.approx((0.1, -0.2, 1.5), rel=1e-6)
    assert (state.battery_V, state.battery_A, state.battery_percentage) == (3.9, 2.5, 0.8)
    assert messages.decode(messages.Autopilot, messages.encode(state)) == state


def test_unknown_figures_and_other_senders_are_not_taken(vehicle: Vehicle, pilot: Pilot) -> None:
    ground = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    beat = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
    unknown = mavlink.MAVLink_sys_status_message(0, 0, 0, 0, 65535, -1, -1, 0, 0, 0, 0, 0, 0)
    nan = mavlink.MAVLink_attitude_message(0, math.nan, 0, 0, 0, 0, 0)
    os.write(vehicle.master, beat.pack(ground))
    vehicle.say(unknown)
    vehicle.say(nan)
    before = len(pilot.told)
    eventually(lambda: len(pilot.told) > before + 5, step=vehicle.listen)
    state = pilot.told[-1]
    assert not state.connected and state.heartbeats == 0
    assert (state.battery_V, state.battery_A, state.battery_percentage) == (None, None, None)
    assert state.roll_rad is None


def test_a_line_that_is_unplugged_is_opened_again_and_nothing_waits_for_it(
    vehicle: Vehicle, pilot: Pilot
) -> None:
    pilot.poses_until(vehicle.estimates)
    vehicle.unplug()
    for _ in range(1000):
        pilot.pose(1.0)
    vehicle.plug()
    vehicle.heard.clear()
    pilot.poses_until(vehicle.estimates)
    pilot.poses_until(lambda: pilot.told[-1].lines_opened >= 2)


def test_a_line_that_nobody_reads_neither_blocks_poses_nor_the_end(
    vehicle: Vehicle, pilot: Pilot
) -> None:
    for _ in range(3000):  # more than a terminal's buffer holds
        pilot.pose(1.0)
        time.sleep(0.0002)
    ended = threading.Thread(target=pilot.autopilot.stop)
    ended.start()
    ended.join(5)
    assert not ended.is_alive()


def test_a_line_that_is_not_there_is_waited_for(tmp_path: Path) -> None:
    told: list[messages.Autopilot] = []
    settings = AutopilotSettings(uri=f"serial:{tmp_path}/none", period_s=0.1)
    waiting = autopilot.open_autopilot(settings, told.append)
    waiting.start()
    eventually(lambda: len(told) > 1, step=lambda: time.sleep(0.01))
    waiting.stop()
    assert not told[-1].connected and told[-1].lines_opened == 0
    assert "No such file" in told[-1].reason


def test_a_vehicle_that_falls_silent_is_not_quoted_any_more(
    vehicle: Vehicle, pilot: Pilot, monkeypatch: pytest.MonkeyPatch
) -> None:
    eventually(lambda: pilot.told and pilot.told[-1].connected, step=vehicle.live)
    monkeypatch.setattr("pi_firmware.autopilot.line._SILENT_S", 0.05)
    eventually(lambda: not pilot.told[-1].connected, step=vehicle.listen)
    assert pilot.autopilot.armed  # as far as anybody knows: what would stop its video is refused
    assert pilot.told[-1].battery_V is None and pilot.told[-1].armed is None


def test_a_telemetry_that_fails_does_not_stop_the_poses(vehicle: Vehicle) -> None:
    def broken(state: messages.Autopilot) -> None:
        raise RuntimeError("closed")

    pilot = Pilot(vehicle, broken, period_s=60)
    pilot.autopilot.start()
    pilot.poses_until(lambda: len(vehicle.estimates()) > 3)
    pilot.autopilot.stop()


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("udp:127.0.0.1", "unknown scheme (available: serial:, off:)"),
        ("serial:", "expected serial:/dev/TTY?baud=RATE"),
        ("serial:/dev/x?baud=1", "baud is '1'; allowed: 1200 to 4e+06"),
        ("serial:/dev/x?rate=1", "unknown option 'rate'"),
        ("off:x", "takes no path"),
    ],
)
def test_a_wrong_autopilot_is_refused_in_one_line(text: str, named: str) -> None:
    with pytest.raises(SourceError) as caught:
        autopilot.open_autopilot(AutopilotSettings(uri=text))
    assert named in str(caught.value) and "\n" not in str(caught.value)


def test_nothing_of_it_is_imported_while_it_is_off() -> None:
    code = (
        "import sys; from pi_firmware import autopilot, battery, settings\n"
        "autopilot.open_autopilot(settings.AutopilotSettings()).start()\n"
        "battery.open_gauge('fake:')\n"
        "print(sorted({'serial', 'pymavlink', 'smbus2'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout == "[]\n"
