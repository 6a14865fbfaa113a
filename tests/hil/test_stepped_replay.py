"""A stepped replay: the same poses in each run, bit for bit, and others after any change."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tomli_w
from links.proxy import ProxyLink

from ground_station.localization.settings import preset_file
from ground_station.map import store
from ground_station.replay.cases.case import Link
from ground_station.replay.replay import ReplayResult, replay, settings_for
from ground_station.replay.rig import LOOPBACK, Rig

SAMPLE = Path(__file__).parents[2] / "maps" / "atrium"
FLOWN_S = 1.0


def stepped(*payload: str, preset: str = "default", rig: Rig = LOOPBACK) -> ReplayResult:
    """The sample flight's first seconds."""
    how = settings_for(
        preset, SAMPLE / "flight.mcap", duration_s=FLOWN_S, stepped=True, payload=payload
    )
    return replay(store.load(SAMPLE), how, rig)


@pytest.fixture(scope="module")
def once() -> ReplayResult:
    return stepped()


def poses(result: ReplayResult) -> list[bytes]:
    """Each frame's pose and covariance as they lie in memory."""
    return [
        np.array(estimate.wTc).tobytes() + np.array(estimate.covariance).tobytes()
        for estimate in (frame.estimate for frame in result.live.frames)
    ]


def test_no_frame_is_lost_or_dropped_and_all_are_localized(once: ReplayResult) -> None:
    accounts = once.live.accounts()
    frames = round(30 * FLOWN_S)
    assert accounts["captured"] == accounts["received"] == accounts["localized"] == frames
    assert accounts["lost"] == accounts["dropped"] == 0 and once.live.complete
    assert once.evaluation is not None
    assert once.evaluation.errors["none"].rmse()["position_m"] < 0.05


def test_two_runs_give_the_same_poses_bit_for_bit(once: ReplayResult) -> None:
    assert poses(stepped()) == poses(once)


def test_one_constant_changed_is_seen(once: ReplayResult, tmp_path: Path) -> None:
    default = tomllib.loads(preset_file("default").read_text())
    default["pose"]["sigma_px"] *= 1.001
    changed = tmp_path / "changed.toml"
    changed.write_text(tomli_w.dumps(default))
    assert poses(stepped(preset=str(changed))) != poses(once)


def test_frames_that_never_come_hold_nothing_up() -> None:
    """More of them in a row than may be on their way: no pose comes back for any.

    By the payload's settings, which are the firmware's own, nothing is sent again or corrected.
    """
    link = ProxyLink(Link(kind="proxy", seed=1, loss=0.3))
    unrecovered = "link.history_s=0", "link.correction=0"
    flown = stepped(*unrecovered, rig=replace(LOOPBACK, link=link)).live
    accounts = flown.accounts()
    assert flown.complete and accounts["captured"] == accounts["sent"] == round(30 * FLOWN_S)
    assert accounts["received"] < accounts["sent"] / 2
