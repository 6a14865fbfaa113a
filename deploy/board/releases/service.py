"""The firmware's service as systemd sees it."""

from __future__ import annotations

import time
from typing import NamedTuple

from deploy.errors import DeployError
from deploy.run import run

UNIT = "blimp-payload.service"
WATCH = "blimp-release-watch.service"
TELEMETRY_UP = "telemetry up"
"""What the firmware's status line says while a ground station reports its video."""
ARMED = "autopilot armed"
"""What it says while the autopilot is."""
_COMMAND_S = 20.0
_NAMES = (
    "ActiveState,SubState,NRestarts,StatusText,Result,ExecMainStatus,ActiveEnterTimestampMonotonic"
)


class Seen(NamedTuple):
    """The service at one moment; `active` means that fresh frames came (READY=1)."""

    active: bool = False
    active_s: float = 0.0
    restarts: int = 0
    telemetry: bool = False
    said: str = "unknown"
    armed: bool = False


class Service:
    """Speaks to systemd; a systemd that does not answer is a service that is not seen."""

    def restart(self) -> None:
        """Starts the firmware again and forgets how often it was; does not wait for it."""
        self._do("reset-failed", UNIT)
        self._do("restart", "--no-block", UNIT)

    def watch(self) -> None:
        """Starts the watcher of a trial, which the path unit does, too."""
        self._do("start", "--no-block", WATCH)

    def seen(self) -> Seen:
        """How the service is now."""
        return judge(self._do("show", f"--property={_NAMES}", UNIT), time.monotonic())

    @staticmethod
    def _do(*words: str) -> str:
        try:
            said = run(["systemctl", *words], timeout_s=_COMMAND_S, ok=range(256))
        except DeployError:
            return ""
        return said.decode(errors="replace")


def judge(shown: str, now_s: float) -> Seen:
    """What systemd's properties mean; `now_s` is the monotonic clock they are compared with."""
    found = dict(line.split("=", 1) for line in shown.splitlines() if "=" in line)
    active = found.get("ActiveState") == "active"
    since_us, restarts = found.get("ActiveEnterTimestampMonotonic", ""), found.get("NRestarts", "")
    said = found.get("ActiveState") or "unknown"
    if found.get("Result", "success") != "success":
        said += f", {found['Result']}"
    if found.get("ExecMainStatus", "0") != "0":
        said += f", status {found['ExecMainStatus']}"
    return Seen(
        active,
        max(now_s - int(since_us) / 1e6, 0.0) if active and since_us.isdigit() else 0.0,
        int(restarts) if restarts.isdigit() else 0,
        TELEMETRY_UP in found.get("StatusText", ""),
        said,
        active and ARMED in found.get("StatusText", ""),
    )
