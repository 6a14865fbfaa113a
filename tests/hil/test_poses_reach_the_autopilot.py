"""The whole way of a pose: recording, firmware, link, localizer, firmware, autopilot."""

from __future__ import annotations

import os
import pty
import select
import threading
import tty
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from ground_station.map import store
from ground_station.recording.flight import trajectory_of
from ground_station.replay import replay

SAMPLE = Path(__file__).parents[2] / "maps" / "atrium"


class Vehicle:
    """An autopilot's end of a serial line, which keeps what it is told; a context manager."""

    def __init__(self) -> None:
        self.master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)
        self.estimates: list[Any] = []
        self._coder = mavlink.MAVLink(None)
        self._coder.robust_parsing = True
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Vehicle:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        self._thread.join()
        os.close(self.master)
        os.close(self._slave)

    def _run(self) -> None:
        while not self._closing.is_set():
            if select.select([self.master], [], [], 0.05)[0]:
                for message in self._coder.parse_buffer(os.read(self.master, 4096)) or []:
                    if message.get_type() in ("ODOMETRY", "VISION_POSITION_ESTIMATE"):
                        self.estimates.append(message)


def test_poses_of_the_localizer_reach_the_autopilot(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are where the truth is, in the autopilot's frame, and the payload hears of its link."""
    settings = replay.settings_for(
        "default", SAMPLE / "flight.mcap", start_s=2.0, duration_s=3.0, rate_hz=10.0, stepped=True
    )
    config = replay._payload_config
    with Vehicle() as vehicle:
        # However slow the machine: a pose that came late is sent all the same.
        autopilot = {"uri": f"serial:{vehicle.path}?baud=921600", "max_age_s": 5.0}
        monkeypatch.setattr(
            replay, "_payload_config", lambda *given: config(*given) | {"autopilot": autopilot}
        )
        result = replay.replay(store.load(SAMPLE), settings)
    localized = [frame for frame in result.live.frames if frame.estimate.localized]
    # The last ones meet a payload that has ended, on a slow machine more of them.
    assert len(localized) >= 15 and 3 <= len(vehicle.estimates) <= len(localized)
    by_clock = {frame.clock_ns // 1000: frame for frame in localized}
    truth = trajectory_of(SAMPLE / "flight.mcap")
    speeds: list[tuple[float, float]] = []
    for message in vehicle.estimates:
        frame = by_clock[
            getattr(message, "usec", 0) or message.time_usec
        ]  # of the payload's clock at capture
        now = int(np.searchsorted(truth.time_ns, frame.estimate.time_ns))
        at = truth.position_m[now]
        # North, east and down are the map's x, -y and -z.
        np.testing.assert_allclose([message.x, -message.y, -message.z], at, atol=0.3)
        if message.get_type() != "ODOMETRY":
            continue  # the first ones have no velocity yet
        assert message.pose_covariance[0] > 0 and 1 <= message.quality <= 100
        around = [now - 3, now + 3]
        moved_m = np.diff(truth.position_m[around], axis=0)[0]
        speed_mps = np.linalg.norm(moved_m) / (1e-9 * np.diff(truth.time_ns[around])[0])
        ahead = np.linalg.norm([message.vx, message.vy, message.vz])
        speeds.append((ahead, speed_mps))
    assert len(speeds) >= 3
    told, flown = np.array(speeds).T
    assert abs(np.median(told - flown)) < 0.1
    health = result.live.payload.health
    assert health is not None and health.round_trip_s is not None and health.round_trip_s < 10
    assert health.lost in (None, 0.0)
