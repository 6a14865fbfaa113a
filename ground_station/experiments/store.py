"""Where experiments keep what they made: by key, so that a stopped run goes on where it was."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ground_station.experiments.plan import FlightJob, Job, LensJob, MapJob
from ground_station.files import write_json


@dataclass(frozen=True)
class Store:
    """A folder with `flights`, `maps` and `runs`, each entry whole or not there, and a `cache`."""

    folder: Path

    def flight(self, name: str) -> Path:
        """A flight's recording, or what calibration found of its camera."""
        return self.folder / "flights" / name

    def map(self, key: str) -> Path:
        """A map's folder."""
        return self.folder / "maps" / key

    @property
    def cache(self) -> Path:
        """The folder of what maps are made of, kept beyond the end of a killed build."""
        return self.folder / "cache"

    def result(self, key: str) -> Path:
        """A run's figures, or why a calibration, a map or a run failed."""
        return self.folder / "runs" / f"{key}.json"

    def done(self, job: Job) -> bool:
        """Whether a job's result is there, a lasting failure included."""
        if isinstance(job, FlightJob):
            from ground_station.experiments.flights import points_of

            path = self.flight(job.name)
            return path.is_file() and (not job.flight.clicked or points_of(path).is_file())
        if isinstance(job, LensJob) and self.flight(job.name).is_file():
            return True
        if isinstance(job, MapJob) and (self.map(job.key) / "map.toml").is_file():
            return True
        return self.read(job.key) is not None

    def read(self, key: str) -> dict[str, Any] | None:
        """A result; None where there is none, or the file is not whole."""
        try:
            document = json.loads(self.result(key).read_text())
        except (OSError, ValueError, RecursionError):
            return None
        return document if isinstance(document, dict) else None

    def write(self, key: str, result: dict[str, Any]) -> None:
        """Keeps a result."""
        path = self.result(key)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, result)

    def failure(self, job: Job) -> dict[str, Any] | None:
        """What is kept of a job that gave nothing, None where it gave something or was not tried.

        `failed` says why; with `accident` it says nothing of the map or the localizer.
        """
        kept = self.read(job.key)
        return kept if kept is not None and "failed" in kept else None
