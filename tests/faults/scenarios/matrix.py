"""The named scenarios: each fault alone, and those pairs of which one could hide the other."""

from __future__ import annotations

from scenarios import hostile_steps as hostile
from scenarios import keys_steps as certificates
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
    _one("the air again, across a restart", hostile.AirReplayed(0, 8)),
    _one("flood of garbage", hostile.Flood(0, 8, "garbage")),
    _one("flood of streams", hostile.Flood(0, 8, "streams")),
    _one("flood of forged packets", hostile.Flood(0, 8, "forged")),
    _one("clients that abort at every byte", hostile.Aborting(0, 20)),
    _one("dashboard without descriptors", hostile.Descriptors(0, 8, "web")),
    _one("intake without descriptors", hostile.Descriptors(0, 8, "intake")),
    # Certificates.
    _one("keys rotated", *(certificates.KeysRotated(15.0 * n, 12) for n in range(3))),
    _one("payload's certificate ends", certificates.CertificateEnds(0, 16)),
    _one("another's certificate revoked", certificates.Revoked(0, 8)),
    _one("two stations command", certificates.SecondStation(0, 10)),
    _one("two payloads of one name", certificates.Twin(0, 12)),
    # The payload.
    _one("payload killed", payload.PayloadKilled(0, 2)),
    _one("payload restarted", payload.PayloadRestarted(0, 1)),
    _one("payload stopped", payload.PayloadStopped(0, 4)),
    _one("payload's clock forward", payload.PayloadClock(0, 8, HOUR_S)),
    _one("payload's clock back", payload.PayloadClock(0, 8, -HOUR_S)),
    _one("camera goes and comes back", payload.CameraFault(0, 12, "gone")),
    _one("camera hangs", payload.CameraFault(0, 12, "hangs")),
    _one("camera stuck", payload.CameraFault(0, 16, "stuck")),
    _one("camera black", payload.CameraFault(0, 16, "black")),
    _one("camera frozen", payload.CameraFault(0, 16, "frozen")),
    _one("camera elsewhere", payload.CameraFault(0, 10, "pattern")),
    _one("encoder stalls", payload.EncoderStalls(0, 4)),
    _one("gauge talks nonsense", payload.GaugeFault(0, 8, "nonsense")),
    _one("gauge absent", payload.GaugeFault(0, 8, "absent")),
    _one("gauge's line held low", payload.GaugeFault(0, 12, "stuck")),
    _one("undervoltage", payload.Undervoltage(0, 12)),
    _one("armed, on a line with noise", payload.LineNoise(0, 20)),
    _one("card full", payload.CardFault(0, 6)),
    _one("card bad", payload.CardFault(0, 6, "bad")),
    _one("card read-only", payload.CardFault(0, 6, "read-only")),
    _one("card stalls", payload.CardFault(0, 6, "stalls")),
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
    _one("disk full", service.DiskFault(0, 6), disk_MB=24),
    _one("files that may not grow", service.DiskFault(0, 6)),
    _one("folder of recordings taken", service.FolderTaken(0, 5)),
    _one("decoder segfaults", service.Killed(0, 0, "intake", "SIGSEGV")),
    _one("disk bad", service.DiskFault(0, 6, "bad")),
    _one("disk read-only", service.DiskFault(0, 6, "read-only")),
    _one("disk stalls", service.DiskFault(0, 6, "stalls")),
    _one("laptop asleep", service.Asleep(0, 20)),
    _one("laptop wakes an hour later", service.Asleep(0, 4), service.GroundClock(2, 10, HOUR_S)),
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
        service.DiskFault(0, 8),
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
BRIEF = ("outage", "localizer stopped", "payload killed", "bad telemetry", "flood of streams")
"""Those of `make test`: of the air, the ground, the payload and the peers."""


def named(*names: str) -> list[Scenario]:
    """Those whose name has one of these in it; all without any."""
    return [one for one in MATRIX if not names or any(name in one.name for name in names)]
