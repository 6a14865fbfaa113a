"""Random walks: steps drawn by a seed, any of them overlapping, and the fewest that still fail."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence

from scenarios import disk, flood
from scenarios import hostile_steps as hostile
from scenarios import link_steps as link
from scenarios import payload_steps as payload
from scenarios import service_steps as service
from scenarios.step import Scenario, Step

WALK_S = 30.0
_EVERY_S = 4.0
"""A step begins this often, on average."""

Draw = Callable[[random.Random, float, float], Step]
"""(chance, at_s, for_s) -> a step."""

DRAWS: tuple[Draw, ...] = (
    lambda d, at, t: link.Loss(at, t, round(d.uniform(0.01, 0.3), 3)),
    lambda d, at, t: link.Bursts(at, t, round(d.uniform(0.002, 0.03), 4)),
    lambda d, at, t: link.Late(at, t, round(d.uniform(0, 0.2), 3), round(d.uniform(0, 0.1), 3)),
    lambda d, at, t: link.Reordered(at, t, round(d.uniform(0.01, 0.3), 3), d.randint(1, 8)),
    lambda d, at, t: link.Duplicated(at, t, round(d.uniform(0.05, 0.5), 3)),
    lambda d, at, t: link.Outage(at, t, d.random() < 0.5),
    lambda d, at, t: link.TelemetryCut(at, t),
    lambda d, at, t: link.TelemetryBlocked(at, t),
    lambda d, at, t: hostile.Garbage(at, t),
    lambda d, at, t: hostile.Stranger(at, t, d.randrange(1 << 32)),
    lambda d, at, t: hostile.OldPackets(at, t, round(d.uniform(1, 6), 1)),
    lambda d, at, t: hostile.BadTelemetry(at, t),
    lambda d, at, t: hostile.CommandFlood(at, t),
    lambda d, at, t: hostile.SlowViewers(at, t, d.randint(1, 8)),
    lambda d, at, t: hostile.HostileHttp(at, t),
    lambda d, at, t: hostile.AirReplayed(at, t),
    lambda d, at, t: hostile.Flood(at, t, d.choice(flood.KINDS)),
    lambda d, at, t: hostile.Aborting(at, t),
    lambda d, at, t: hostile.Descriptors(at, t, d.choice(("intake", "web"))),
    lambda d, at, t: payload.PayloadKilled(at, t),
    lambda d, at, t: payload.PayloadRestarted(at, t),
    lambda d, at, t: payload.PayloadStopped(at, t),
    lambda d, at, t: payload.PayloadClock(at, t, round(d.uniform(-5000, 5000), 1)),
    lambda d, at, t: payload.CameraFault(
        at, t, d.choice(("black", "frozen", "gone", "pattern", "stuck"))
    ),
    lambda d, at, t: payload.EncoderStalls(at, min(t, 4.0)),
    lambda d, at, t: payload.GaugeFault(at, t, d.choice(tuple(payload.GAUGES))),
    lambda d, at, t: payload.CardFault(at, t, d.choice(disk.KINDS)),
    lambda d, at, t: service.Killed(at, 0.0, d.choice(("intake", "localizer", "web"))),
    lambda d, at, t: service.Stopped(at, t, d.choice(("intake", "localizer", "web", "station"))),
    lambda d, at, t: service.Asleep(at, t),
    lambda d, at, t: service.ServiceKilled(at, t / 2),
    lambda d, at, t: service.GroundClock(at, t, round(d.uniform(-5000, 5000), 1)),
    lambda d, at, t: service.DiskFault(at, t, d.choice(disk.KINDS)),
    lambda d, at, t: service.FolderTaken(at, t),
)


def drawn(seed: int, duration_s: float = WALK_S) -> Scenario:
    """The walk of a seed: the same steps each time, all of them repaired within the duration."""
    draw = random.Random(seed)
    steps = []
    for _ in range(max(2, round(duration_s / _EVERY_S))):
        for_s = round(draw.uniform(1.0, min(8.0, duration_s / 3)), 1)
        at_s = round(draw.uniform(0.0, duration_s - for_s), 1)
        steps.append(draw.choice(DRAWS)(draw, at_s, for_s))
    return Scenario(f"walk {seed}", tuple(sorted(steps, key=lambda step: step.at_s)))


def shrunk(scenario: Scenario, fails: Callable[[Scenario], bool]) -> Scenario:
    """The fewest steps that still fail, by delta debugging (Zeller and Hildebrandt, 2002).

    Complements of ever smaller parts are tried; `fails` runs one. What fails by chance only may end
    with more steps than needed, never with a scenario that was not seen to fail.
    """
    steps, parts = list(scenario.steps), 2
    while len(steps) >= 2:
        size = -(-len(steps) // parts)
        for begin in range(0, len(steps), size):
            rest = [*steps[:begin], *steps[begin + size :]]
            if rest and fails(_with(scenario, rest)):
                steps, parts = rest, max(parts - 1, 2)
                break
        else:
            if parts >= len(steps):
                break
            parts = min(2 * parts, len(steps))
    return _with(scenario, steps)


def _with(scenario: Scenario, steps: Sequence[Step]) -> Scenario:
    name = f"{scenario.name}, {len(steps)} of {len(scenario.steps)} steps"
    return Scenario(name, tuple(steps), scenario.disk_MB, scenario.foxglove)
