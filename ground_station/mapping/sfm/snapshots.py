"""Models on the way, kept on disk whole or not at all: a killed build goes on from the newest."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from ground_station.errors import MapError
from ground_station.files import write_json
from ground_station.map import colmap, colmap_files
from pi_firmware.wire import files

_KEPT = 2
"""The newest and the one before: after a power cut the newest may hold nothing."""
_STATE = "state.json"
_PART = ".part"

State = dict[str, int]


class Snapshots:
    """A folder of models, each with whole numbers that say where the work stood.

    Each is written beside and renamed; what a killed program left half is swept away.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        for part in folder.glob("*" + _PART):
            shutil.rmtree(part)

    def save(self, name: str, model: colmap.Reconstruction, **state: int) -> None:
        """Writes a model under a name; raises `MapError` when the disk does not take it."""
        target = self._folder / name
        part = target.with_name(name + _PART)
        colmap.write(model, part)
        write_json(part / _STATE, state)
        shutil.rmtree(target, ignore_errors=True)
        files.replace(part, target)

    def load(self, name: str) -> tuple[colmap.Reconstruction, State] | None:
        """The model of that name and its state; None where there is none that is whole."""
        folder = self._folder / name
        try:
            colmap_files.check(folder)
            state = json.loads((folder / _STATE).read_text())
            return colmap.reread(folder), {str(key): int(value) for key, value in state.items()}
        except (MapError, OSError, ValueError, TypeError, AttributeError):
            return None

    def reread(self, name: str) -> colmap.Reconstruction:
        """The model just saved, as a later program would find it."""
        return colmap.reread(self._folder / name)

    def newest(self, prefix: str) -> tuple[colmap.Reconstruction, State] | None:
        """The last by name of those that are whole and whose name begins so."""
        for name in reversed(self.names(prefix)):
            found = self.load(name)
            if found is not None:
                return found
        return None

    def names(self, prefix: str = "") -> list[str]:
        """In order, whole or not."""
        return sorted(p.name for p in self._folder.glob(f"{prefix}*") if p.suffix != _PART)

    def sweep(self, prefix: str, kept: int = _KEPT) -> None:
        """Removes all but the newest of those whose name begins so."""
        names = self.names(prefix)
        for name in names[: max(0, len(names) - kept)]:
            shutil.rmtree(self._folder / name, ignore_errors=True)
