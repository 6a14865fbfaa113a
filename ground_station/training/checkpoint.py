"""Where training stands, on disk: arrays and numbers, no code, whole or not there.

A checkpoint is a safetensors file with a checksum, written beside and renamed. The last few stay,
so that one that the disk lost in a power cut is not the only one.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from ground_station.training.errors import TrainingError
from pi_firmware.wire import files
from pi_firmware.wire.errors import os_errors_as

Arrays = Mapping[str, npt.NDArray[Any]]
_NAME = re.compile(r"step-(\d{7})\.safetensors")
_KEPT = 3


@dataclass(frozen=True)
class Checkpoint:
    """`arrays` by name, and `state`, a JSON object; `step` is the next to be done."""

    step: int
    arrays: Arrays
    state: dict[str, Any]


def _digest(arrays: Arrays) -> str:
    digest = hashlib.sha256()
    for name in sorted(arrays):
        digest.update(name.encode())
        digest.update(arrays[name].tobytes())
    return digest.hexdigest()


def write(folder: Path, checkpoint: Checkpoint, keep_every: int) -> Path:
    """Writes one and removes old ones, but for those at whole multiples of `keep_every` steps."""
    path = folder / f"step-{checkpoint.step:07d}.safetensors"
    note = {"state": json.dumps(checkpoint.state), "sha256": _digest(checkpoint.arrays)}
    data = save({k: np.array(v, order="C") for k, v in checkpoint.arrays.items()}, note)
    with os_errors_as(path, TrainingError):
        files.write(path, data)
        for step, old in steps(folder)[:-_KEPT]:
            if step % keep_every:
                old.unlink()
    return path


def steps(folder: Path) -> list[tuple[int, Path]]:
    """The checkpoints in a folder, oldest first."""
    found = ((_NAME.fullmatch(path.name), path) for path in folder.glob("step-*.safetensors"))
    return sorted((int(match[1]), path) for match, path in found if match)


def read(path: Path) -> Checkpoint:
    """Reads and checks one; raises `TrainingError` with one line."""
    match = _NAME.fullmatch(path.name)
    if match is None:
        raise TrainingError(f"{path}: a checkpoint is called step-NNNNNNN.safetensors")
    try:
        with safe_open(path, "numpy") as file:
            note = file.metadata() or {}
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        state = json.loads(note["state"])
        whole = note["sha256"] == _digest(arrays)
    except (OSError, SafetensorError, KeyError, ValueError) as error:
        raise TrainingError(f"{path}: {str(error).splitlines()[0]}") from None
    if not whole or not isinstance(state, dict):
        raise TrainingError(f"{path}: damaged, its checksum is another")
    return Checkpoint(int(match[1]), arrays, state)


def newest(folder: Path) -> Checkpoint | None:
    """The newest one that is whole; None without any. Raises where all there are, are damaged."""
    last: TrainingError | None = None
    for _, path in reversed(steps(folder)):
        try:
            return read(path)
        except TrainingError as error:
            last = error
    if last is not None:
        raise last
    return None
