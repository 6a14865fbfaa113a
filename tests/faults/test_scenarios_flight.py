"""One flight that four scenarios and a short walk befall: whatever happens, the invariants hold.

`tests/faults/scenarios/run.py` flies all of them.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
from scenarios.camera import Cameras
from scenarios.matrix import BRIEF, MATRIX
from scenarios.play import found, play
from scenarios.step import Scenario
from scenarios.walk import drawn
from scenarios.world import shims_there

pytestmark = pytest.mark.alone

WALK_SEED, WALK_S = 1, 8.0
FAULT_S = 2.0


def short(scenario: Scenario) -> Scenario:
    """The same with faults of two seconds."""
    steps = (dataclasses.replace(step, for_s=min(step.for_s, FAULT_S)) for step in scenario.steps)
    return dataclasses.replace(scenario, steps=tuple(steps))


def test_whatever_befalls_a_flight_the_invariants_hold(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not shims_there():
        pytest.skip("no C compiler for the shims")
    scenarios = [one for one in MATRIX if one.name in BRIEF]
    walk = drawn(WALK_SEED, WALK_S)
    monkeypatch.chdir(tmp_path)  # a folder may be named from where one stands
    verdicts = play(Path("flight"), Cameras(tmp_path), [*map(short, scenarios), walk])
    for verdict in verdicts:
        back_s, burden = verdict.figures.get("recovery_s"), verdict.figures.get("burden")
        print(f"\n{verdict.name}: {verdict.injected}, back {back_s} s, burden {burden}", end="")
    assert not found(verdicts), "\n".join(verdicts[-1].said)
    assert all(verdict.injected for verdict in verdicts)
    figures = verdicts[-1].figures
    assert figures["frames"] > 100 and figures["estimates"]["TRACKING"] > 20
    assert figures["link"]["lost"] > 0 and figures["payloads"] > 1
