"""Lets scenarios befall one world, one after the other, and judges what came of it."""

from __future__ import annotations

import shutil
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path

import httpx

from scenarios.camera import Cameras
from scenarios.judge import TRACKING, Verdict, judge
from scenarios.step import Scenario, Step, as_json
from scenarios.world import LIMIT_S, NAME, World, tick

RECOVERED_S, STARTED_S = 20.0, 45.0
"""Bounds for all to be back after the last fault, without and with a process that starts anew.

Of a machine with two cores on which others work, too: a start takes 5 to 15 s there.
"""
_STILL_S = 1.0
_PAYLOAD_FRESH_S = 2.0


def play(
    folder: Path, cameras: Cameras, scenarios: Sequence[Scenario], *, seed: int = 0
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
    took_s = recovery_s(world, time.monotonic(), LIMIT_S)
    if took_s is None:
        verdict.broken["recovery"].append(f"never tracked at all within {LIMIT_S:g} s")
        return False
    world.say(f"tracked {took_s:.1f} s after the start")
    return True


def _befall(world: World, scenario: Scenario, verdict: Verdict) -> None:
    began_s = time.monotonic()
    happenings = sorted(
        [(step.at_s, 0, n) for n, step in enumerate(scenario.steps)]
        + [(step.until_s, 1, n) for n, step in enumerate(scenario.steps)]
    )
    begun: set[int] = set()
    for due_s, ends, number in happenings:
        step = scenario.steps[number]
        while time.monotonic() < began_s + due_s:
            tick(world)
        if ends and number in begun and step.for_s:
            _do(world, f"mended: {type(step).__name__}", step.mend)
        elif ends:
            _do(world, "", step.mend) if number in begun else None
        else:
            begun.add(number)
            verdict.injected.append(str(step))
            _do(world, str(step), step.inject)
    mended_s = time.monotonic()
    bound_s = STARTED_S if scenario.starts else RECOVERED_S
    took_s = recovery_s(world, mended_s, bound_s)
    verdict.figures |= {"recovery_s": None if took_s is None else round(took_s, 2)}
    if took_s is None:
        verdict.broken["recovery"].append(f"not within {bound_s:g} s: {_lacks(world, mended_s)}")
        world.say(f"BROKEN no recovery: {_lacks(world, mended_s)}")
    else:
        world.say(f"recovered in {took_s:.1f} s")
    still_s = time.monotonic() + _STILL_S
    while time.monotonic() < still_s:
        tick(world)


def _do(world: World, text: str, what: Callable[[World], None]) -> None:
    if text:
        world.say(text)
    try:
        what(world)
    except Exception as error:
        world.complain(f"{text or 'mending'}: {type(error).__name__}: {str(error)[:300]}")


def recovery_s(world: World, since_s: float, bound_s: float) -> float | None:
    """Seconds until all is back of what came after a moment; None when not within the bound."""
    while time.monotonic() < since_s + bound_s:
        if not _lacks(world, since_s):
            return time.monotonic() - since_s
        tick(world)
    return None


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


def _talks(health: dict[str, object] | None, world: World) -> bool:
    """Whether the payload's newest process is the one that was heard of last."""
    uptime_s = health.get("uptime_s") if health else None
    if not isinstance(uptime_s, float | int):
        return False
    return abs(time.monotonic() - world.run.began_s - uptime_s) < 10.0


def describe(step: Step) -> str:
    """A step in one line."""
    return str(step)
