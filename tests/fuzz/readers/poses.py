"""`pi_firmware.autopilot.poses`: which poses of the ground's an autopilot may fly by."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from pieces import Picker, as_json, changed, refusing

from pi_firmware.autopilot.poses import PoseGate
from pi_firmware.settings import AutopilotSettings
from pi_firmware.wire import messages
from pi_firmware.wire.errors import TelemetryError
from readers.messages import KINDS

_EXAMPLE = next(kind for kind in KINDS if isinstance(kind, messages.Pose))


def fuzz(data: bytes) -> None:
    """What is given out is finite in the single precision that MAVLink has."""
    picker, now_ns = Picker(data), 10**12
    gate = PoseGate(AutopilotSettings())
    while picker.left():
        now_ns += picker.number(4)
        document = {
            **dataclasses.asdict(_EXAMPLE),
            "schema": "blimp.pose/1.0",
            "capture_ns": now_ns - picker.number(4),
            "position_m": [picker.real() for _ in range(3)],
        }
        if picker.number(1) % 2:
            document["quaternion_xyzw"] = [picker.real() for _ in range(4)]
        if picker.number(1) % 2:
            document["covariance"] = [picker.real() for _ in range(36)]
        with refusing(TelemetryError):
            message = messages.decode(messages.Pose, as_json(changed(picker, document)))
            pose = gate.take(message, now_ns)
            if pose is not None:
                numbers = [*pose.position_m, *pose.angles_rad, *pose.upper_triangle()[1:]]
                assert np.isfinite(np.array(numbers, np.float32)).all()
                assert all(map(math.isfinite, numbers))
        assert 0 <= gate.reset_counter < 256


def seeds() -> list[bytes]:
    """Poses in a row; far ones; with a covariance."""
    one = bytes(4) * 2 + bytes(24) + b"\0\0" + bytes(12)
    far = bytes(4) * 2 + bytes(6) + b"\xf0\x7f" + bytes(16) + b"\0\0" + bytes(12)
    sure = bytes(4) * 2 + bytes(24) + b"\0\1" + bytes(36 * 8) + bytes(12)
    return [one * 3, far, one + sure]
