"""What a run leaves behind: a folder with its frames, its poses, its figures and what made them.

`result.json` holds the figures and settings and is written last: a folder with it is whole.
`frames.csv` is every frame that reached the localizer, `estimate.txt` the poses as TUM text,
`truth.txt` what they are held against, `floorplan.yaml` and `.png` where it was.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import cv2
import msgspec
import yaml
from msgspec import Meta

from ground_station.errors import InputError
from ground_station.files import read_bytes, write_bytes, write_json, write_text
from ground_station.geometry.trajectory import Trajectory, read_tum, write_tum
from ground_station.map.floorplan import FloorPlan, load_floorplan
from ground_station.map.observations import landmarks_sha256
from ground_station.map.store import Map
from ground_station.replay.cases.frames import Frames, read_csv, write_csv
from ground_station.replay.resources import Side
from pi_firmware.wire.config import key
from pi_firmware.wire.errors import os_errors_as
from pi_firmware.wire.messages import Battery, Health

SCHEMA: Final = "blimp.outcome/1"
RESULT, FRAMES, ESTIMATE, TRUTH = "result.json", "frames.csv", "estimate.txt", "truth.txt"
FLOORPLAN, PICTURE = "floorplan.yaml", "floorplan.png"
_MOST_BYTES = 16 << 20


Count = Annotated[int, Meta(ge=-(2**53), le=2**53)]
"""Of frames; one that is reckoned may come out negative, and is then told."""
TimeNs = Annotated[int, Meta(ge=0, le=2**63 - 1)]


@dataclass(frozen=True)
class Accounts:
    """Frames by what became of them, as `LiveResult.accounts` names them."""

    captured: Count = key(0, "taken by the camera")
    gated: Count = key(0, "held back by the payload: too little to see in them")
    discarded: Count = key(0, "passed the gate, but never left the payload")
    sent: Count = key(0, "left the payload over the radio")
    received: Count = key(0, "arrived whole at the ground station")
    lost: Count = key(0, "sent, but never arrived whole")
    dropped: Count = key(0, "arrived, but skipped because newer ones were waiting")
    localized: Count = key(0, "solved from what is seen in them")


@dataclass(frozen=True)
class Outage:
    """When nothing came through, or a fault lasted: by the ground's wall clock."""

    begin_ns: TimeNs = 0
    end_ns: TimeNs = 0
    name: str = "outage"


class Run(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Everything of a run but its frames; what is not known is absent or None.

    `battery` and `health` are the payload's last messages; `refused` counts messages that were not
    as agreed, as one with a NaN is not. `settings` is nested plain values.
    """

    schema: Literal["blimp.outcome/1"] = SCHEMA
    title: str = ""
    case: str = ""
    payload: str = "process"  # or image, or ssh
    link: str = "loopback"  # what carried the video
    recording: str = ""
    map: str = ""
    map_sha256: str = ""  # of its landmarks, descriptors and positions
    preset: str = "default"
    init: str = "none"
    stepped: bool = False
    rate_hz: float = 0.0
    seed: int = 0  # the localizer's
    began: str = ""  # ISO 8601
    seconds: float = 0.0  # it took
    complete: bool = False  # whether the payload's final counts came
    accounts: Accounts = Accounts()
    stream: dict[str, Any] = {}  # the receiver's counters
    link_counts: dict[str, Any] = {}  # what the link did to packets
    clock_offset: dict[str, Any] | None = None  # of the payload's clock
    outages: list[Outage] = []
    battery: Battery | None = None
    health: Health | None = None
    refused: Count | None = None
    payload_side: Side = Side()
    ground_side: Side = Side()
    versions: dict[str, Any] = {}  # of programs
    settings: dict[str, Any] = {}  # of localizer and firmware
    notes: list[str] = []  # what a reader must know


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


def map_sha256(map_: Map) -> str:
    """Of a map's landmarks with their descriptors and where they are: another one, other poses."""
    digest = hashlib.sha256(landmarks_sha256(map_.landmarks).encode())
    digest.update(map_.landmarks.position_m.astype("<f8").tobytes())
    return digest.hexdigest()


def write_outcome(folder: str | Path, outcome: Outcome) -> None:
    """Writes the folder again; raises `GroundStationError` when the disk refuses."""
    folder = Path(folder)
    with os_errors_as(folder, InputError):
        folder.mkdir(parents=True, exist_ok=True)
        for name in (RESULT, TRUTH, FLOORPLAN):
            (folder / name).unlink(missing_ok=True)
    write_csv(folder / FRAMES, outcome.frames)
    write_tum(folder / ESTIMATE, outcome.estimate)
    if outcome.truth is not None:
        write_tum(folder / TRUTH, outcome.truth)
    if outcome.floorplan is not None:
        _write_floorplan(folder, outcome.floorplan)
    document = {k: v for k, v in msgspec.to_builtins(outcome.run).items() if v is not None}
    write_json(folder / RESULT, document)


def read_outcome(folder: str | Path) -> Outcome:
    """Reads a run's folder, or what `blimp replay` wrote around one.

    Raises `InputError` or `GeometryError` with one line.
    """
    folder = Path(folder)
    inner = folder / "outcome"
    if not (folder / RESULT).is_file() and (inner / RESULT).is_file():
        folder = inner
    run = _read_run(folder / RESULT)
    plan = folder / FLOORPLAN
    truth = folder / TRUTH
    return Outcome(
        run,
        read_csv(folder / FRAMES),
        read_tum(truth) if truth.is_file() else None,
        load_floorplan(plan) if plan.is_file() else None,
        folder,
    )


def _read_run(path: Path) -> Run:
    if not path.is_file():
        made = f"blimp replay RECORDING --map MAP --out {path.parent}"
        raise InputError(f"{path.parent}: no run's outcome is there; {made} writes one")
    try:
        return msgspec.json.decode(read_bytes(path, _MOST_BYTES), type=Run)
    except (msgspec.DecodeError, RecursionError) as error:
        raise InputError(f"{path}: not a run's result: {error}") from None


def _write_floorplan(folder: Path, plan: FloorPlan) -> None:
    _, data = cv2.imencode(".png", plan.image)
    write_bytes(folder / PICTURE, data.tobytes())
    told = {"image": PICTURE, "resolution": plan.resolution_m, "origin": list(plan.origin)}
    write_text(folder / FLOORPLAN, yaml.safe_dump(told))
