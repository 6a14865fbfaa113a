"""The outcome of a replay that has just ended."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import importlib.metadata
import platform
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

import ground_station
import pi_firmware
from ground_station.geometry.trajectory import Trajectory
from ground_station.map.floorplan import FloorPlan, load_floorplan
from ground_station.map.store import Map
from ground_station.replay.cases import frames
from ground_station.replay.cases.outcome import Accounts, Outage, Outcome, Run, map_sha256
from ground_station.replay.replay import ReplayResult
from ground_station.replay.resources import Side
from pi_firmware.wire import messages

_LIBRARIES = ("numpy", "scipy", "opencv-python-headless", "gtsam", "av")
"""Those whose next version may give another pose."""


def outcome_of(
    result: ReplayResult, map_: Map, *, outages: Sequence[Outage] = (), **more: Any
) -> Outcome:
    """What a replay found, ready to be written, judged and compared; `more` is of `Run`.

    `outages` are by this machine's wall clock. Of a payload elsewhere whose resources nobody
    measured, its health message tells.
    """
    settings, live = result.settings, result.live
    payload_side, health = result.payload_side, live.payload.health
    if payload_side is None and health is not None:
        payload_side = Side(health.memory_MB, health.cpu, "its health message")
    captured_ns = live.captured_ns() if live.clock else [frames.UNKNOWN] * len(live.frames)
    table = frames.table(live.frames, captured_ns)
    run = Run(
        recording=settings.recording.name,
        map=map_.info.name,
        map_sha256=map_sha256(map_),
        preset=settings.preset,
        init=settings.init if settings.init in ("none", "truth") else "file",
        stepped=settings.stepped,
        rate_hz=settings.rate_hz,
        seed=result.localizer.seed,
        began=datetime.now(UTC).isoformat(timespec="seconds"),
        complete=live.complete,
        accounts=Accounts(**live.accounts()),
        stream=live.payload.stream,
        clock_offset=live.clock,
        outages=list(outages),
        battery=live.payload.battery,
        health=health,
        refused=live.payload.refused,
        payload_side=payload_side or Side(),
        ground_side=result.ground_side,
        versions=versions() | _firmware_version(health),
        settings={
            "replay": _plain(dataclasses.asdict(settings), without=("recording", "pictures")),
            "localizer": dataclasses.asdict(result.localizer),
            "camera": result.camera.as_dict(),
        },
        **{"title": f"Replay of {settings.recording.name}"} | more,
    )
    return Outcome(run, table, within(result.truth, table), floorplan_of(map_))


def within(truth: Trajectory | None, table: frames.Frames) -> Trajectory | None:
    """The truth from the first to the last frame: the stretch that was flown; None when empty."""
    if truth is None or not len(table):
        return None
    keep = (truth.time_ns >= table.time_ns.min()) & (truth.time_ns <= table.time_ns.max())
    return truth[keep] if np.any(keep) else None


def floorplan_of(map_: Map) -> FloorPlan | None:
    """The plan in a map's folder, where it has one."""
    path = None if map_.folder is None else map_.folder / "floorplan.yaml"
    return load_floorplan(path) if path is not None and path.is_file() else None


def _firmware_version(health: messages.Health | None) -> dict[str, str]:
    if health is None or not health.version:
        return {}
    how = f" ({health.release})" if health.release else ""
    return {"pi_firmware": f"{health.version}{how}"}


def _plain(settings: dict[str, Any], without: tuple[str, ...]) -> dict[str, Any]:
    return {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in settings.items()
        if name not in without
    }


def versions() -> dict[str, str]:
    """Names and versions of what a pose depends on, the machine's kind included."""
    found = {
        "ground_station": f"{ground_station.__version__}, source {source_sha256()[:12]}",
        "pi_firmware": pi_firmware.__version__,
        "python": platform.python_version(),
        "machine": platform.machine(),
    }
    for name in _LIBRARIES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


@functools.cache
def source_sha256() -> str:
    """Of every .py and .toml file of both packages, by name and content."""
    digest = hashlib.sha256()
    for package in (ground_station, pi_firmware):
        root = Path(str(package.__file__)).parent
        for path in sorted(p for p in root.rglob("*") if p.suffix in (".py", ".toml")):
            content = path.read_bytes()
            name = f"{root.name}/{path.relative_to(root).as_posix()}"
            digest.update(f"{name}\0{len(content)}\0".encode() + content)
    return digest.hexdigest()
