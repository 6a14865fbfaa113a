"""What the poses of a case are held against, wherever it comes from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ground_station.errors import InputError
from ground_station.geometry.trajectory import Trajectory, read_tum
from ground_station.recording.flight import trajectory_of
from ground_station.replay.cases.case import GOLDEN, NONE, RECORDING, Case
from ground_station.replay.cases.golden import Golden, read_golden


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
