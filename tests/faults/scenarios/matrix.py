"""The named scenarios: each fault alone, and those pairs of which one could hide the other."""

from __future__ import annotations

from scenarios import hostile_steps as hostile
from scenarios import link_steps as link
from scenarios import payload_steps as payload
from scenarios import service_steps as service
from scenarios.step import Scenario, Step

HOUR_S = 3600.0


def _one(name: str, *steps: Step, disk_MB: int = 0, foxglove: bool = False) -> Scenario:
    return Scenario(name, steps, disk_MB, foxglove)


MATRIX: tuple[Scenario, ...] = (
    # The air.
    _one("loss of 5 %", link.Loss(0, 8, 0.05)),
    _one("loss of 20 %", link.Loss(0, 8, 0.2)),
    _one("bursts", link.Bursts(0, 8, 0.02)),
    _one("delay and jitter", link.Late(0, 8, 0.1, 0.05)),
    _one("reordering", link.Reordered(0, 8, 0.1, 3)),
    _one("duplicates", link.Duplicated(0, 8, 0.3)),
    _one("outage", link.Outage(0, 8)),
    _one("outage of video and telemetry", link.Outage(0, 8, True)),
    _one("telemetry cut", link.TelemetryCut(0, 8)),
    _one("telemetry blocked", link.TelemetryBlocked(0, 15)),
    # Who else is on it.
    _one("garbage datagrams", hostile.Garbage(0, 8)),
    _one("a stranger's stream", hostile.Stranger(0, 16)),
    _one("old packets again", hostile.OldPackets(0, 8)),
    _one("bad telemetry", hostile.BadTelemetry(0, 8)),
    _one("flood of commands", hostile.CommandFlood(0, 8)),
    _one("slow viewers", hostile.SlowViewers(0, 10, 6)),
    _one("hostile HTTP", hostile.HostileHttp(0, 8)),
    # The payload.
    _one("payload killed", payload.PayloadKilled(0, 2)),
    _one("payload restarted", payload.PayloadRestarted(0, 1)),
    _one("payload stopped", payload.PayloadStopped(0, 4)),
    _one("payload's clock forward", payload.PayloadClock(0, 8, HOUR_S)),
    _one("payload's clock back", payload.PayloadClock(0, 8, -HOUR_S)),
    _one("camera goes and comes back", payload.CameraFault(0, 12, "gone")),
    _one("camera hangs", payload.CameraFault(0, 12, "hangs")),
    _one("camera black", payload.CameraFault(0, 16, "black")),
    _one("camera frozen", payload.CameraFault(0, 16, "frozen")),
    _one("camera elsewhere", payload.CameraFault(0, 10, "pattern")),
    _one("encoder stalls", payload.EncoderStalls(0, 4)),
    _one("gauge talks nonsense", payload.GaugeFault(0, 8, "nonsense")),
    _one("gauge absent", payload.GaugeFault(0, 8, "absent")),
    _one("card full", payload.CardFull(0, 6)),
    # The ground station.
    _one("intake killed", service.Killed(0, 0, "intake")),
    _one("localizer killed", service.Killed(0, 0, "localizer")),
    _one("web killed", service.Killed(0, 0, "web")),
    _one("Foxglove killed", service.Killed(0, 0, "foxglove"), foxglove=True),
    _one("service killed", service.ServiceKilled(0, 2)),
    _one("service restarted", service.ServiceRestarted(0, 2)),
    _one("localizer stopped", service.Stopped(0, 4, "localizer")),
    _one("localizer stopped for good", service.Stopped(0, 14, "localizer")),
    _one("intake stopped", service.Stopped(0, 3, "intake")),
    _one("parent stopped", service.Stopped(0, 3, "station")),
    _one("ground's clock forward", service.GroundClock(0, 8, HOUR_S)),
    _one("ground's clock back", service.GroundClock(0, 8, -HOUR_S)),
    _one("disk full", service.DiskFull(0, 6), disk_MB=24),
    _one("files that may not grow", service.DiskFull(0, 6)),
    _one("folder of recordings taken", service.FolderTaken(0, 5)),
    # Two at once.
    _one(
        "loss, and the localizer killed", link.Loss(0, 10, 0.1), service.Killed(3, 0, "localizer")
    ),
    _one("outage, and the intake killed", link.Outage(0, 8), service.Killed(3, 0, "intake")),
    _one(
        "payload and service killed",
        payload.PayloadKilled(0, 4),
        service.ServiceKilled(1, 1),
    ),
    _one(
        "disk full, and the service killed",
        service.DiskFull(0, 8),
        service.ServiceKilled(3, 1),
    ),
    _one(
        "clock set while telemetry is blocked",
        link.TelemetryBlocked(0, 8),
        payload.PayloadClock(2, 10, -HOUR_S),
    ),
    _one(
        "camera black, jitter, and bad telemetry",
        payload.CameraFault(0, 14, "black"),
        link.Late(2, 8, 0.1, 0.05),
        hostile.BadTelemetry(1, 10),
    ),
    _one(
        "payload killed, and old packets again",
        payload.PayloadKilled(0, 2),
        hostile.OldPackets(1, 9),
    ),
)
BRIEF = ("outage", "localizer stopped", "payload killed", "bad telemetry")
"""Those of `make test`: one of the air, the ground, the payload and the peers."""


def named(*names: str) -> list[Scenario]:
    """Those whose name has one of these in it; all without any."""
    return [one for one in MATRIX if not names or any(name in one.name for name in names)]
