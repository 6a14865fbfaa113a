"""MAVLink 2 with an autopilot over a serial line, on a thread of its own."""

from __future__ import annotations

import contextlib
import math
import select
import socket
import threading
import time
from collections.abc import Callable
from typing import Any

import serial
from pymavlink.dialects.v20 import common as mavlink

from pi_firmware.autopilot import Autopilot
from pi_firmware.autopilot.poses import PoseGate, VehiclePose
from pi_firmware.settings import AutopilotSettings
from pi_firmware.wire.messages import Autopilot as State
from pi_firmware.wire.messages import Pose

_HEARTBEAT_S = 1.0
_SILENT_S = 3.0  # without its heartbeat for so long the autopilot is gone
_TICK_S = 0.2
_WRITE_LIMIT_S = 0.2
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 5.0
_JOIN_LIMIT_S = 2.0
_AUTOPILOT_COMPONENT = 1
_UNKNOWN_MV = 0xFFFF


def _quality(share: float | None) -> int:
    """As MAVLink has it: percent from 1, 0 where it is not known."""
    return 0 if share is None else round(min(max(100 * share, 1), 100))


def as_mavlink(usec: int, pose: VehiclePose, quality: float | None, resets: int) -> Any:
    """The message for a pose: an `ODOMETRY`, or without a velocity a `VISION_POSITION_ESTIMATE`."""
    if pose.velocity_mps is not None and pose.turn_radps is not None:
        return mavlink.MAVLink_odometry_message(
            usec,
            mavlink.MAV_FRAME_LOCAL_FRD,  # the one that both ArduPilot and PX4 take
            mavlink.MAV_FRAME_BODY_FRD,
            *pose.position_m.tolist(),
            pose.quaternion_wxyz(),
            *pose.velocity_mps.tolist(),
            *pose.turn_radps.tolist(),
            pose.upper_triangle(),
            [math.nan] + [0.0] * 20,
            resets,
            mavlink.MAV_ESTIMATOR_TYPE_VISION,
            _quality(quality),
        )
    return mavlink.MAVLink_vision_position_estimate_message(
        usec,
        *(float(v) for v in pose.position_m),
        *(float(v) for v in pose.angles_rad),
        pose.upper_triangle(),
        resets,
    )


class SerialAutopilot(Autopilot):
    """Sends `ODOMETRY`, and keeps what heartbeat, attitude and battery say.

    A pose without a velocity goes as `VISION_POSITION_ESTIMATE`: not every autopilot takes an
    `ODOMETRY` whose velocity is unknown for what it is.

    Only the newest pose waits; a line that is slow, stuck or gone costs poses and nothing else. A
    line that vanishes is opened again, ever more seldom up to 5 s.
    """

    def __init__(
        self,
        settings: AutopilotSettings,
        path: str,
        baud: int,
        system: int,
        component: int,
        publish: Callable[[State], None],
    ) -> None:
        self.poses = PoseGate(settings)
        self._settings = settings
        self._path, self._baud = path, baud
        self._publish = publish
        self._coder = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
        self._coder.robust_parsing = True
        self._lock = threading.Lock()
        self._waiting: Pose | None = None
        self._woken, self._waker = socket.socketpair()
        self._woken.setblocking(False)
        self._waker.setblocking(False)
        self._end = threading.Event()
        self._thread: threading.Thread | None = None
        self._values: dict[str, Any] = {}
        self._heard_s = -math.inf
        self._reason = ""
        self._heartbeats = self._lines = 0
        self._sent = 0
        self._next_heartbeat_s = self._next_state_s = 0.0

    def start(self) -> None:
        """Starts the thread; a second call does nothing."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="autopilot", daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """Ends the thread; waits no longer than a stuck line is worth."""
        self._end.set()
        self._wake()
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.join(_JOIN_LIMIT_S)

    def on_pose(self, message: Pose) -> None:
        """Lays a pose ready; an older one that still waits is never sent."""
        with self._lock:
            self._waiting = message
        self._wake()

    def state(self) -> State:
        """What is known of the autopilot now, and the counters."""
        connected = time.monotonic() - self._heard_s < _SILENT_S
        if not connected:
            self._values = {}  # what it said before it fell silent is no longer so
        return State(
            time_ns=time.time_ns(),
            connected=connected,
            reason=self._reason,
            heartbeats=self._heartbeats,
            sent=self._sent,
            **vars(self.poses.counts),
            reset_counter=self.poses.reset_counter,
            lines_opened=self._lines,
            **self._values,
        )

    def _run(self) -> None:
        pause_s = _FIRST_PAUSE_S
        while not self._end.is_set():
            lines = self._lines
            try:
                with serial.Serial(
                    self._path, self._baud, timeout=0, write_timeout=_WRITE_LIMIT_S, exclusive=True
                ) as port:
                    self._lines += 1
                    self._reason = ""
                    self._talk(port)
            except Exception as error:  # whatever it is, a flight does not end for a line
                self._reason = str(error)[:200]
            pause_s = _FIRST_PAUSE_S if self._lines > lines else min(2 * pause_s, _LONGEST_PAUSE_S)
            until_s = time.monotonic() + pause_s
            while not self._end.is_set() and time.monotonic() < until_s:
                with contextlib.suppress(Exception):
                    self._judge_waiting()
                    self._publish_state()
                self._end.wait(_TICK_S)

    def _talk(self, port: Any) -> None:
        while not self._end.is_set():
            readable, _, _ = select.select([port.fileno(), self._woken], [], [], _TICK_S)
            if self._woken in readable:
                self._woken.recv(4096)
            if port.fileno() in readable:
                # A device that is gone is readable and gives nothing: pyserial raises then.
                self._hear(port.read(max(port.in_waiting, 1)))
            now_s = time.monotonic()
            if now_s >= self._next_heartbeat_s:
                self._next_heartbeat_s = now_s + _HEARTBEAT_S
                self._write(port, self._own_heartbeat())
            estimate = self._judge_waiting()
            if estimate is not None:
                self._write(port, estimate)
                self._sent += 1
            self._publish_state()

    def _write(self, port: Any, message: Any) -> None:
        port.write(message.pack(self._coder))
        self._coder.seq = (self._coder.seq + 1) % 256

    def _own_heartbeat(self) -> Any:
        return mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_ONBOARD_CONTROLLER,
            mavlink.MAV_AUTOPILOT_INVALID,
            0,
            0,
            mavlink.MAV_STATE_ACTIVE,
            3,
        )

    def _judge_waiting(self) -> Any | None:
        """The estimate to send, if a pose waits that may be."""
        with self._lock:
            message, self._waiting = self._waiting, None
        if message is None:
            return None
        pose = self.poses.take(message, time.time_ns())
        if pose is None:
            return None
        return as_mavlink(
            message.capture_ns // 1000, pose, message.quality, self.poses.reset_counter
        )

    def _hear(self, data: bytes) -> None:
        for message in self._coder.parse_buffer(data) or ():
            if message.get_type() != "BAD_DATA" and (
                message.get_srcComponent() == _AUTOPILOT_COMPONENT
            ):
                self._note(message)

    def _note(self, message: Any) -> None:
        kind = message.get_type()
        if kind == "HEARTBEAT" and message.autopilot != mavlink.MAV_AUTOPILOT_INVALID:
            self._heard_s = time.monotonic()
            self._heartbeats += 1
            self.armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
            self._values |= {
                "armed": self.armed,
                "mode": int(message.custom_mode),
                "system_status": int(message.system_status),
            }
        elif kind == "ATTITUDE":
            angles = (message.roll, message.pitch, message.yaw)
            if all(map(math.isfinite, angles)):
                self._values |= dict(zip(("roll_rad", "pitch_rad", "yaw_rad"), angles, strict=True))
        elif kind == "SYS_STATUS":
            self._note_battery(
                message.voltage_battery, message.current_battery, message.battery_remaining
            )
        elif kind == "BATTERY_STATUS" and message.id == 0:
            cells = [mv for mv in message.voltages if mv != _UNKNOWN_MV]
            self._note_battery(
                sum(cells) if cells else _UNKNOWN_MV,
                message.current_battery,
                message.battery_remaining,
            )

    def _note_battery(self, voltage_mv: int, current_ca: int, remaining: int) -> None:
        """Each has its own word for unknown: 65535 mV, -1 centiampere, -1 percent."""
        self._values |= {
            "battery_V": None if voltage_mv == _UNKNOWN_MV else voltage_mv / 1000,
            "battery_A": None if current_ca < 0 else current_ca / 100,
            "battery_percentage": remaining / 100 if 0 <= remaining <= 100 else None,
        }

    def _publish_state(self) -> None:
        now_s = time.monotonic()
        if now_s >= self._next_state_s:
            self._next_state_s = now_s + self._settings.period_s
            self._publish(self.state())

    def _wake(self) -> None:
        with contextlib.suppress(OSError):  # full: it is awake anyway
            self._waker.send(b"\0")
