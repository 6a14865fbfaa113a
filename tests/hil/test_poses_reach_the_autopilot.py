"""The whole way of a pose: recording, firmware, link, localizer, firmware, autopilot."""

from __future__ import annotations

import contextlib
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ground_station.map import store
from ground_station.recording.flight import trajectory_of
from ground_station.replay import replay

sys.path.append(str(Path(__file__).parents[1] / "pi_firmware"))
from odometry_filter import OdometryFilter
from vehicle import Vehicle

SAMPLE = Path(__file__).parents[2] / "maps" / "atrium"


@contextlib.contextmanager
def listening(line: Path) -> Iterator[list[Any]]:
    """An autopilot's end of a serial line, and the poses that it is told."""
    vehicle, closing = Vehicle(line), threading.Event()

    def listen() -> None:
        while not closing.is_set():
            vehicle.listen()

    thread = threading.Thread(target=listen, daemon=True)
    thread.start()
    poses: list[Any] = []
    try:
        yield poses
    finally:
        closing.set()
        thread.join()
        vehicle.unplug()
    kinds = ("ODOMETRY", "VISION_POSITION_ESTIMATE")
    poses += [message for message in vehicle.heard if message.get_type() in kinds]


def test_poses_of_the_localizer_reach_the_autopilot(tmp_path: Path) -> None:
    """They are where the truth is, in the autopilot's frame, and the payload hears of its link."""
    line = tmp_path / "line"
    settings = replay.settings_for(
        "default", SAMPLE / "flight.mcap", start_s=2.0, duration_s=3.0, rate_hz=10.0, stepped=True,
        # However slow the machine: a pose that came late is sent all the same.
        payload=(f"autopilot.uri=serial:{line}?baud=921600", "autopilot.max_age_s=5"),
    )  # fmt: skip
    with listening(line) as told:
        result = replay.replay(store.load(SAMPLE), settings)
    localized = [frame for frame in result.live.frames if frame.estimate.localized]
    # The last ones meet a payload that has ended, on a slow machine more of them.
    assert len(localized) >= 15 and 3 <= len(told) <= len(localized)
    by_clock = {frame.clock_ns // 1000: frame for frame in localized}
    truth = trajectory_of(SAMPLE / "flight.mcap")
    speeds: list[tuple[float, float]] = []
    for message in told:
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
    said, flown = np.array(speeds).T
    assert abs(np.median(said - flown)) < 0.1
    pilot, missed = OdometryFilter(), []
    for message in told:
        if message.get_type() == "ODOMETRY":
            # A stepped flight takes its time: what moved, moved by the frames' clock.
            message.time_usec = by_clock[message.time_usec].estimate.time_ns // 1000
            missed.append(pilot.take(message))
    missed = missed[1:]
    # Of nine degrees of freedom: 99 % are below 21.7. It knows less of what the vehicle does.
    assert np.median(missed) < 9 and max(missed) < 2 * 21.7
    health = result.live.payload.health
    assert health is not None and health.round_trip_s is not None and health.round_trip_s < 10
    assert health.lost in (None, 0.0)
