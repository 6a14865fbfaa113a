"""Results of runs as the store keeps them, without a flight; and the document of such runs."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from ground_station.experiments import declaration, summary
from ground_station.experiments.plan import Plan
from ground_station.experiments.store import Store

Runs = dict[str, list[dict[str, Any] | None]]
"""By preset, one for each seed; None: not measured."""


def run(errors_m: list[float | None], *, seed: int = 0, step: int = 1) -> dict[str, Any]:
    """A run whose frame k, at k/10 s, has that error; None: it was not localized.

    It sees one frame in `step`.
    """
    seen = [(k / 10, e) for k, e in enumerate(errors_m)][::step]
    found = [(t, e) for t, e in seen if e is not None]
    errors = [e for _, e in found]
    rmse = math.sqrt(sum(e * e for e in errors) / len(errors)) if errors else None
    return {
        "captured": len(errors_m),
        "frames": len(seen),
        "seen_s": [t for t, _ in seen],
        "localized": len(errors),
        "tracking": len(errors),
        "wrong": sum(error > 0.25 for error in errors),
        "first_s": found[0][0] if found else None,
        "landmarks": 1234,
        "keyframes": 20,
        "stage_s": {"features": 0.02, "total": 0.05},
        "recovery_s": None,
        "position_m": rmse,
        "rotation_deg": None if rmse is None else 10 * rmse,
        "position_zhang_m": rmse,
        "aligned_m": rmse,
        "p95_m": max(errors, default=None),
        "smoothed_m": None if rmse is None else 0.9 * rmse,
        "consistency": {"nees": 6.0, "inside_95": 0.95},
        "series": {
            "time_s": [t for t, _ in found],
            "x_m": [5 + math.cos(t) for t, _ in found],
            "y_m": [5 + math.sin(t) for t, _ in found],
            "position_m": errors,
            "rotation_deg": [10 * e for e in errors],
        },
    }


def document(folder: Path, text: str, runs: dict[tuple[str, str], Runs]) -> dict[str, Any]:
    """Of a file of experiments with that text; `runs` by the names of experiment and case."""
    path, store = folder / "e.toml", Store(folder / "store")
    path.write_text(text)
    keys: dict[tuple[str, str], dict[str, list[str]]] = {}
    for row, presets in runs.items():
        keys[row] = {}
        for preset, found in presets.items():
            keys[row][preset] = [f"{'-'.join(row)}-{preset}-{k}" for k in range(len(found))]
            for key, one in zip(keys[row][preset], found, strict=True):
                if one is not None:
                    store.write(key, one)
    about = {"machine": {"cores": 2, "date": "2026-11-27"}, "jobs": 2, "quick": False}
    return summary.summarise(declaration.load(path), Plan({}, {}, keys), store, about)
