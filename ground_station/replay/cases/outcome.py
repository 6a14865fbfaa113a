"""What a run leaves behind: a folder with its frames, its poses, its figures and what made them.

`result.json` holds the figures and settings and is written last: a folder with it is whole.
`frames.csv` is every frame that reached the localizer, `estimate.txt` the poses as TUM text,
`truth.txt` what they are held against, `floorplan.yaml` and `.png` where it was.
"""

from __future__ import annotations

import dataclasses
import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import msgspec
import yaml

from ground_station.errors import InputError
from ground_station.files import write_bytes, write_json, write_text
from ground_station.geometry.trajectory import Trajectory, read_tum, write_tum
from ground_station.map.floorplan import FloorPlan, load_floorplan
from ground_station.map.observations import landmarks_sha256
from ground_station.map.store import Map
from ground_station.replay.cases.frames import Frames, read_csv, write_csv
from ground_station.replay.resources import Side
from pi_firmware.wire import config
from pi_firmware.wire.config import key, table

SCHEMA = "blimp.outcome/1"
RESULT, FRAMES, ESTIMATE, TRUTH = "result.json", "frames.csv", "estimate.txt", "truth.txt"
FLOORPLAN, PICTURE = "floorplan.yaml", "floorplan.png"
_MOST_BYTES = 16 << 20


def _count(doc: str) -> Any:
    """A number of frames; one that is reckoned may come out negative, and is then told."""
    return key(0, doc, low=-(2**53), high=2**53)


@dataclass(frozen=True)
class Accounts:
    """Frames by what became of them, as `LiveResult.accounts` names them."""

    captured: int = _count("taken by the camera")
    gated: int = _count("held back by the payload: too little to see in them")
    discarded: int = _count("passed the gate, but never left the payload")
    sent: int = _count("left the payload over the radio")
    received: int = _count("arrived whole at the ground station")
    lost: int = _count("sent, but never arrived whole")
    dropped: int = _count("arrived, but skipped because newer ones were waiting")
    localized: int = _count("solved from what is seen in them")


@dataclass(frozen=True)
class Outage:
    """When nothing came through, or a fault lasted: by the ground's wall clock."""

    begin_ns: int = key(0, "its begin", unit="ns", low=0, high=2**63 - 1)
    end_ns: int = key(0, "its end", unit="ns", low=0, high=2**63 - 1)
    name: str = key("outage", "what it was")


@dataclass(frozen=True)
class Run:
    """Everything of a run but its frames; what is not known is absent or None.

    `battery` and `health` are the payload's last messages as they came; `refused` counts messages
    that were not as agreed, as one with a NaN is not. `settings` is nested plain values.
    """

    schema: str = key(SCHEMA, "this file's kind", choices=(SCHEMA,))
    title: str = key("", "what was flown")
    case: str = key("", "the case's name")
    payload: str = key("process", "process, image or ssh")
    link: str = key("loopback", "what carried the video")
    recording: str = key("", "the flight's file")
    map: str = key("", "the map's name")
    map_sha256: str = key("", "of its landmarks, descriptors and positions")
    preset: str = key("default", "the localizer's settings")
    init: str = key("none", "the first frame's pose")
    stepped: bool = key(False, "whether no clock decided anything")
    rate_hz: float = key(0.0, "frames captured a second", unit="Hz")
    seed: int = key(0, "the localizer's")
    began: str = key("", "when, ISO 8601")
    seconds: float = key(0.0, "how long it took", unit="s", low=0.0)
    complete: bool = key(False, "whether the payload's final counts came")
    accounts: Accounts = table(Accounts)
    stream: dict[str, Any] = key({}, "the receiver's counters")
    link_counts: dict[str, Any] = key({}, "what the link did to packets")
    clock_offset: dict[str, Any] | None = key(None, "the payload's clock")
    outages: list[dict[str, Any]] = key([], "each an `Outage`")
    battery: dict[str, Any] | None = key(None, "the last message")
    health: dict[str, Any] | None = key(None, "the last message")
    refused: int | None = key(None, "messages that were not as agreed", low=0, high=2**53)
    payload_side: dict[str, Any] = key({}, "a `Side`")
    ground_side: dict[str, Any] = key({}, "a `Side`")
    versions: dict[str, Any] = key({}, "of programs")
    settings: dict[str, Any] = key({}, "of localizer and firmware")
    notes: list[str] = key([], "what a reader must know")


@dataclass(frozen=True)
class Outcome:
    """A run with its frames, the truth of the stretch flown and the floor plan, where known."""

    run: Run
    frames: Frames
    truth: Trajectory | None = None
    floorplan: FloorPlan | None = None
    folder: Path | None = None

    @property
    def estimate(self) -> Trajectory:
        """Its poses by capture time."""
        return self.frames.trajectory()

    @property
    def outages(self) -> list[Outage]:
        """In order of time; raises `ConfigError` for one that is not as agreed."""
        found = [config.from_mapping(item, Outage, where=RESULT) for item in self.run.outages]
        return sorted(found, key=lambda outage: outage.end_ns)

    def side(self, name: str) -> Side:
        """The resources of `payload` or `ground`; raises `ConfigError`."""
        told = getattr(self.run, f"{name}_side")
        known = {k: v for k, v in told.items() if v is not None}
        return config.from_mapping(known, Side, where=f"{RESULT}: {name}_side")


def map_sha256(map_: Map) -> str:
    """Of a map's landmarks with their descriptors and where they are: another one, other poses."""
    digest = hashlib.sha256(landmarks_sha256(map_.landmarks).encode())
    digest.update(map_.landmarks.position_m.astype("<f8").tobytes())
    return digest.hexdigest()


def write_outcome(folder: str | Path, outcome: Outcome) -> None:
    """Writes the folder again; raises `GroundStationError` when the disk refuses."""
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name in (RESULT, TRUTH, FLOORPLAN):
            (folder / name).unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: {error.strerror or error}") from None
    write_csv(folder / FRAMES, outcome.frames)
    write_tum(folder / ESTIMATE, outcome.estimate)
    if outcome.truth is not None:
        write_tum(folder / TRUTH, outcome.truth)
    if outcome.floorplan is not None:
        _write_floorplan(folder, outcome.floorplan)
    document = {k: v for k, v in dataclasses.asdict(outcome.run).items() if v is not None}
    write_json(folder / RESULT, document)


def read_outcome(folder: str | Path) -> Outcome:
    """Reads a run's folder, or what `blimp replay` wrote around one.

    Raises `InputError`, `ConfigError` or `GeometryError` with one line.
    """
    folder = Path(folder)
    inner = folder / "outcome"
    if not (folder / RESULT).is_file() and (inner / RESULT).is_file():
        folder = inner
    run = _read_run(folder / RESULT)
    plan = folder / FLOORPLAN
    truth = folder / TRUTH
    outcome = Outcome(
        run,
        read_csv(folder / FRAMES),
        read_tum(truth) if truth.is_file() else None,
        load_floorplan(plan) if plan.is_file() else None,
        folder,
    )
    # Told now and by name, not when a figure is taken.
    _ = outcome.outages, outcome.side("payload"), outcome.side("ground")
    return outcome


def _read_run(path: Path) -> Run:
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise InputError(f"{path}: larger than {_MOST_BYTES >> 20} MiB")
        document = msgspec.json.decode(path.read_bytes(), type=dict[str, Any])
    except FileNotFoundError:
        made = f"blimp replay RECORDING --map MAP --out {path.parent}"
        raise InputError(f"{path.parent}: no run's outcome is there; {made} writes one") from None
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None
    except (msgspec.DecodeError, RecursionError):
        raise InputError(f"{path}: not a JSON object") from None
    return config.from_mapping(document, Run, where=str(path))


def _write_floorplan(folder: Path, plan: FloorPlan) -> None:
    _, data = cv2.imencode(".png", plan.image)
    write_bytes(folder / PICTURE, data.tobytes())
    told = {"image": PICTURE, "resolution": plan.resolution_m, "origin": list(plan.origin)}
    write_text(folder / FLOORPLAN, yaml.safe_dump(told))
