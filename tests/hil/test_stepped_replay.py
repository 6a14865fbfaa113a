"""A stepped replay: the same poses in each run, bit for bit, and others after any change."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ground_station.localization.settings import LocalizerSettings, load_preset
from ground_station.map import store
from ground_station.replay.replay import ReplayResult, replay, settings_for

SAMPLE = Path(__file__).parents[2] / "maps" / "atrium"
FLOWN_S = 3.0


def stepped(settings: LocalizerSettings, *payload: str) -> ReplayResult:
    """The sample flight's first seconds."""
    how = settings_for(
        "default", SAMPLE / "flight.mcap", duration_s=FLOWN_S, stepped=True, payload=payload
    )
    return replay(store.load(SAMPLE), settings, how)


@pytest.fixture(scope="module")
def once() -> ReplayResult:
    return stepped(load_preset("default"))


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
    assert poses(stepped(load_preset("default"))) == poses(once)


def test_one_constant_changed_is_seen(once: ReplayResult) -> None:
    default = load_preset("default")
    changed = replace(default, pose=replace(default.pose, sigma_px=default.pose.sigma_px * 1.001))
    assert poses(stepped(changed)) != poses(once)


def test_the_payloads_settings_are_the_firmwares_own(once: ReplayResult) -> None:
    """Half the bit rate: other pictures, so other poses of the same frames."""
    other = stepped(load_preset("default"), "encoder.bitrate_kbps=1000")
    assert len(poses(other)) == len(poses(once)) and poses(other) != poses(once)
