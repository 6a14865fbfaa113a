"""What the poses of a case are held against, wherever it comes from.

The accepted result of an earlier run is a TUM text file, which any tool of trajectories reads: its
poses, how far others may be off, and who took it. What is not a pose stands in comments that begin
with `#: ` and are TOML together.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

import tomli_w

from ground_station.errors import InputError
from ground_station.geometry.trajectory import Trajectory, read_tum, write_tum
from ground_station.recording.flight import trajectory_of
from ground_station.replay.cases.case import GOLDEN, NONE, RECORDING, Case
from ground_station.replay.cases.outcome import Outcome
from pi_firmware.wire import config
from pi_firmware.wire.config import key
from pi_firmware.wire.text import printable

MARK = "#: "
MISSING = 0.05
"""The share of the accepted poses that a run may be without, where nobody says otherwise."""


_OF_RUN = ("case", "recording", "map", "map_sha256", "preset", "payload")
_LONGEST = 200


@dataclass(frozen=True)
class Accepted:
    """Who accepted what, and how far another run may be from it."""

    accepted_by: str = key("", "who")
    accepted_at: str = key("", "when, ISO 8601")
    tolerance_m: float = key(0.0, "farthest a position may be off", unit="m", low=0.0, high=1e3)
    tolerance_deg: float = key(0.0, "farthest a rotation may be", unit="°", low=0.0, high=180.0)
    missing_max: float = key(MISSING, "poses that may be missing", unit="share", low=0.0, high=1.0)
    case: str = key("", "the case's name")
    recording: str = key("", "the flight's file")
    map: str = key("", "the map's name")
    map_sha256: str = key("", "of its landmarks")
    preset: str = key("default", "the localizer's settings")
    payload: str = key("process", "which kind flew")
    stepped: bool = key(False, "whether no clock decided anything")
    versions: dict[str, str] = key({}, "of programs")

    def __post_init__(self) -> None:
        if not self.accepted_by.strip():
            raise ValueError("'accepted_by' is empty; an accepted run has a name under it")
        if not self.accepted_by.isprintable() or len(self.accepted_by) > 100:
            raise ValueError("'accepted_by' is one line of at most 100 characters")


@dataclass(frozen=True)
class Golden:
    """An accepted run: its poses by capture time and its terms."""

    accepted: Accepted
    poses: Trajectory

    def __str__(self) -> str:
        a = self.accepted
        return f"accepted by {a.accepted_by} at {a.accepted_at}"


def accept(
    outcome: Outcome,
    *,
    by: str,
    tolerance_m: float,
    tolerance_deg: float,
    missing_max: float = MISSING,
) -> Golden:
    """What is accepted of a run: its poses; raises `InputError` when it has none to accept."""
    run, where = outcome.run, outcome.folder or "the run"
    poses = outcome.estimate
    if not len(poses):
        raise InputError(f"{where}: no frame was localized; there is nothing to accept")
    if broken := outcome.frames.broken:
        raise InputError(f"{where}: {broken} poses are not finite; such a run cannot be accepted")
    values = {
        "accepted_by": by,
        "accepted_at": datetime.now(UTC).isoformat(timespec="seconds"),
        "tolerance_m": tolerance_m,
        "tolerance_deg": tolerance_deg,
        "missing_max": missing_max,
        **{name: printable(getattr(run, name), _LONGEST) for name in _OF_RUN},
        "stepped": run.stepped,
        "versions": {
            printable(k, _LONGEST): printable(str(v), _LONGEST) for k, v in run.versions.items()
        },
    }
    return Golden(config.from_mapping(values, Accepted, where="--accept"), poses)


def write_golden(path: str | Path, golden: Golden) -> None:
    """Writes the file, beside and renamed."""
    terms = tomli_w.dumps(asdict(golden.accepted)).splitlines()
    comments = [f"# A run that was {golden}.", *((MARK + line).rstrip() for line in terms)]
    write_tum(path, golden.poses, comments)


def read_golden(path: str | Path) -> Golden:
    """Reads such a file; raises `InputError`, `ConfigError` or `GeometryError` with one line."""
    path = Path(path)
    poses = read_tum(path)
    lines = path.read_text(encoding="utf-8").splitlines()
    terms = "\n".join(line[len(MARK) :] for line in lines if line.startswith(MARK.rstrip()))
    try:
        document = config.parse(terms)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: its terms are not valid TOML: {error}") from None
    if "accepted_by" not in document:
        raise InputError(f"{path}: not an accepted run; blimp replay --accept writes one")
    for name in ("tolerance_m", "tolerance_deg"):
        if name not in document:
            raise InputError(f"{path}: the key '{name}' is missing")
    return Golden(config.from_mapping(document, Accepted, where=str(path)), poses)


@dataclass(frozen=True)
class Reference:
    """Poses that stand for the truth, what they are, and the accepted run that they are of."""

    poses: Trajectory
    what: str
    golden: Golden | None = None


def reference_of(case: Case) -> Reference | None:
    """A case's truth; None where it has none. Raises a `BlimpError` with one line."""
    truth, path = case.truth, case.truth_path
    if truth.kind == NONE:
        return None
    if truth.kind == RECORDING:
        poses = trajectory_of(case.recording_path, truth.topic)
        return Reference(poses, f"{truth.topic} of the recording")
    assert path is not None  # a case without it is refused
    if truth.kind == GOLDEN:
        if not path.is_file():
            raise InputError(
                f"{path}: no run was accepted yet; blimp replay --accept OUTCOME --out {path}"
            )
        golden = read_golden(path)
        return Reference(golden.poses, f"the run {golden}", golden)
    return Reference(read_tum(path), f"the survey {Path(truth.file).name}")
