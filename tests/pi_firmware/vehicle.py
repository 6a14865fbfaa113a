"""The autopilot's end of the serial line, on a pseudo-terminal."""

from __future__ import annotations

import os
import pty
import select
import time
import tty
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import common as mavlink


class Vehicle:
    """An ArduPilot vehicle at the far end: MAVLink on a pseudo-terminal's master."""

    def __init__(self, link: Path) -> None:
        self.link = link
        self.coder = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self.coder.robust_parsing = True
        self.heard: list[Any] = []
        self.plug()

    def plug(self) -> None:
        self.master, slave = pty.openpty()
        tty.setraw(slave)
        self.link.unlink(missing_ok=True)
        self.link.symlink_to(os.ttyname(slave))
        os.close(slave)

    def unplug(self) -> None:
        os.close(self.master)

    def say(self, message: Any) -> None:
        os.write(self.master, message.pack(self.coder))

    def listen(self) -> None:
        if select.select([self.master], [], [], 0.02)[0]:
            try:
                data = os.read(self.master, 4096)
            except OSError:  # nobody has the other end open
                time.sleep(0.02)
                return
            self.heard += self.coder.parse_buffer(data) or []

    def estimates(self) -> list[Any]:
        return [m for m in self.heard if m.get_type() == "VISION_POSITION_ESTIMATE"]

    def live(self, armed: bool = True) -> None:
        """What an autopilot says all the time."""
        mode = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        mode |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0
        self.say(mavlink.MAVLink_heartbeat_message(7, 3, mode, 5, mavlink.MAV_STATE_ACTIVE, 3))
        self.say(mavlink.MAVLink_attitude_message(1000, 0.1, -0.2, 1.5, 0, 0, 0))
        self.say(mavlink.MAVLink_sys_status_message(0, 0, 0, 0, 3900, 250, 80, 0, 0, 0, 0, 0, 0))
