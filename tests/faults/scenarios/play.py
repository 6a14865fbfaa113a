"""Lets scenarios befall one world, one after the other, and judges what came of it."""

from __future__ import annotations

import shutil
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import httpx

from pi_firmware.wire.messages import Health
from scenarios.burden import Burden
from scenarios.camera import Cameras
from scenarios.judge import TRACKING, Verdict, judge
from scenarios.step import Scenario, Step, as_json
from scenarios.world import NAME, RATE_HZ, World, tick

RECOVERED_S, STARTED_S = 10.0, 25.0
"""Bounds for all to be back after the last fault, without and with a process that restarts.

Of a machine without other work; where there is some they are stretched by its burden.
"""
_STILL_S, _LOOK_S = 1.0, 0.5
_PAYLOAD_FRESH_S, _NOISE_S = 5.0, 0.5


@dataclass(frozen=True)
class Back:
    """Seconds until all was back, None: it was not; and by how much the machine was burdened."""

    took_s: float | None
    factor: float


def play(
    folder: Path,
    cameras: Cameras,
    scenarios: Sequence[Scenario],
    *,
    seed: int = 0,
    rate_hz: float = RATE_HZ,
) -> list[Verdict]:
    """The scenarios in one flight: each has its own recovery, and all share the flight's account.

    The folder is removed when all invariants held, and kept otherwise.
    """
    verdicts = [Verdict(one.name) for one in scenarios]
    world = World(
        folder,
        cameras,
        disk_MB=max(one.disk_MB for one in scenarios),
        foxglove=any(one.foxglove for one in scenarios),
        seed=seed,
        rate_hz=rate_hz,
    )
    try:
        with world:
            if _begin(world, verdicts[0]):
                for scenario, verdict in zip(scenarios, verdicts, strict=True):
                    _befall(world, scenario, verdict)
            world.finish()
            judge(verdicts[-1], world)
    except Exception:
        verdicts[-1].broken["order"].append(f"the test itself: {traceback.format_exc()[-900:]}")
        verdicts[-1].said = list(world.said)
    for verdict in verdicts[:-1]:  # one flight: its account is that of all
        verdict.share(verdicts[-1])
    if all(verdict.holds for verdict in verdicts):
        shutil.rmtree(folder, ignore_errors=True)
    else:
        for number, scenario in enumerate(scenarios):
            (folder / f"scenario-{number}.json").write_text(as_json(scenario))
        (folder / "story.txt").write_text("\n".join([*world.said, *found(verdicts)]) + "\n")
    return verdicts


def found(verdicts: Sequence[Verdict]) -> list[str]:
    """What was broken, a line each."""
    return [
        f"{verdict.name}: {invariant}: {text}"
        for verdict in verdicts
        for invariant, texts in verdict.broken.items()
        for text in texts
    ]


def _begin(world: World, verdict: Verdict) -> bool:
    began_s = time.monotonic()
    back = recovery(world, began_s, STARTED_S)
    if back.took_s is None:
        lacks = _lacks(world, began_s)
        verdict.figures |= {"burden": round(back.factor, 2)}
        verdict.broken["recovery"].append(f"never tracked from the start on: {lacks}")
        return False
    world.say(f"tracked {back.took_s:.1f} s after the start, burden {back.factor:.1f}")
    return True


def _befall(world: World, scenario: Scenario, verdict: Verdict) -> None:
    began_s = time.monotonic()
    happenings = sorted(
        [(step.at_s, 0, n) for n, step in enumerate(scenario.steps)]
        + [(step.until_s, 1, n) for n, step in enumerate(scenario.steps)]
    )
    begun_s: dict[int, float] = {}
    left, shown = _frames(world)
    for due_s, ends, number in happenings:
        step = scenario.steps[number]
        # One that was late, because another's end took long, still lasts as long as it should.
        least_s = begun_s.get(number, 0.0) + step.for_s if ends else 0.0
        while time.monotonic() < max(began_s + due_s, least_s):
            tick(world)
        if ends and number in begun_s:
            _end(world, step, alone=scenario.alone(step))
        else:
            begun_s[number] = time.monotonic()
            verdict.injected.append(str(step))
            _do(world, str(step), step.inject)
    mended_s = time.monotonic()
    bound_s = STARTED_S if scenario.starts else RECOVERED_S
    back = recovery(world, mended_s, bound_s)
    verdict.figures |= {"recovery_s": back.took_s, "burden": round(back.factor, 2)}
    if back.took_s is None:
        allowed = f"{bound_s:g} s times {back.factor:.1f}"
        verdict.broken["recovery"].append(f"not within {allowed}: {_lacks(world, mended_s)}")
        world.say(f"BROKEN {verdict.broken['recovery'][-1]}")
    else:
        world.say(f"recovered in {back.took_s:.1f} s, burden {back.factor:.1f}")
    still_s = time.monotonic() + _STILL_S
    while time.monotonic() < still_s:
        tick(world)
    left_by_now, shown_by_now = _frames(world)
    gone = left_by_now - left - (shown_by_now - shown)
    verdict.figures |= {"left": left_by_now - left, "lost": max(0, gone)}


def _frames(world: World) -> tuple[int, int]:
    """How many frames have left the payload so far, and how many the ground has shown."""
    return sum(len(run.watch.at_s) for run in world.runs), len(world.heard.frames(NAME))


def _end(world: World, step: Step, *, alone: bool) -> None:
    """Fixes a step; one whose traces no other blurs must have done what it is for."""

    def look(world: World) -> None:
        if lacks := step.lacking(world):
            world.complain(f"{step}: nothing befell: {lacks}")

    if alone:
        _do(world, "", look)
    _do(world, f"repaired: {type(step).__name__}" if step.for_s else "", step.fix)


def _do(world: World, text: str, what: Callable[[World], None]) -> None:
    if text:
        world.say(text)
    try:
        what(world)
    except Exception as error:
        world.complain(f"{text or 'repairing'}: {type(error).__name__}: {str(error)[:300]}")


def recovery(world: World, since_s: float, bound_s: float) -> Back:
    """When all is back of what came after a moment."""
    burden, looked_s = Burden(), 0.0
    while (now_s := time.monotonic()) < since_s + bound_s * burden.factor:
        if not _lacks(world, since_s):
            return Back(now_s - since_s, burden.factor)
        if now_s - looked_s > _LOOK_S:
            looked_s = now_s
            burden.look(world.pids().values())
        tick(world)
    return Back(None, burden.factor)


def _lacks(world: World, since_s: float) -> str:
    """What is not back yet, in words: video, TRACKING, telemetry, the page."""
    ssrc = world.run.ssrc
    frames = world.heard.frames(NAME)
    fresh = next((n for n, one in enumerate(frames) if one.at_s > since_s), len(frames))
    if not any(one.key[0] == ssrc for one in frames[fresh:]):
        return "no video"
    told = [one for one in world.heard.estimates()[-30:] if one.payload_id == NAME]
    if not any(o.at >= fresh and o.ssrc == ssrc and o.note.state == TRACKING for o in told):
        said = f"{told[-1].note.state}, {told[-1].note.reason}" if told else "nothing"
        return f"no TRACKING, but {said}"
    note = world.heard.payload(NAME, max(since_s, time.monotonic() - _PAYLOAD_FRESH_S))
    if note is None or not note.alive or not _talks(note.health, world):
        return "no telemetry"
    try:
        return "" if world.service.answers() else "no page"
    except (AssertionError, httpx.HTTPError):
        return "no page"


def _talks(health: Health | None, world: World) -> bool:
    """Whether what was heard last is of the payload's newest process, and not of one before it."""
    if health is None:
        return False
    return time.monotonic() - health.uptime_s > world.run.began_s - _NOISE_S
