"""From runs to tables: mean and spread over the seeds, and where ours is not the better one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from ground_station.experiments import claims
from ground_station.experiments.declaration import FIGURES, Case, Declaration
from ground_station.experiments.plan import Plan
from ground_station.experiments.store import Store

_COVERAGE = 0.005
"""A smaller share localized by more than this is worse."""


def summarise(
    declaration: Declaration, plan: Plan, store: Store, about: dict[str, Any]
) -> dict[str, Any]:
    """The document of `results.json`, `series` and all; `about` is taken over as it is."""
    experiments: list[dict[str, Any]] = []
    for experiment in declaration.experiments:
        cases = [_case(case, plan, store) for case in experiment.cases]
        experiments.append(
            {
                "name": experiment.name,
                "title": experiment.title,
                "question": experiment.question,
                "thesis_source": experiment.thesis,
                "thesis_times": asdict(experiment.times),
                "level": experiment.level,
                "cases": cases,
            }
        )
    worse = [
        f"{e['title']}, {c['title']}: {reason}"
        for e in experiments
        for c in e["cases"]
        for reason in c["worse"]
    ]
    return about | {
        "seeds": list(declaration.seeds),
        "worse": worse,
        "claims": claims.judge(declaration.claims, experiments),
        "experiments": experiments,
    }


def _case(case: Case, plan: Plan, store: Store) -> dict[str, Any]:
    found = {
        preset: [_told(store.read(key), case) for key in keys]
        for preset, keys in plan.runs[case.experiment, case.name].items()
    }
    presets = {preset: aggregate(runs) for preset, runs in found.items()}
    _common(found, presets)
    return {
        "name": case.name,
        "title": case.title,
        "thesis": {k: v for k, v in asdict(case.thesis).items() if v not in (None, "")},
        "map": asdict(case.map),
        "flight": asdict(case.flight),
        "alter": asdict(case.alter),
        "localizer": dict(case.localizer),
        "presets": presets,
        "worse": worse(presets),
    }


def _told(run: dict[str, Any] | None, case: Case) -> dict[str, Any]:
    """A run with what is derived from it; or that it was not measured.

    `gap_s` is the longest time without a pose, the flight's ends included, and its whole length
    where no frame was localized; `inside_95` the share of poses whose errors fit their covariance.
    """
    if run is None:
        return {"failed": claims.NOT_MEASURED, "accident": True}
    if "failed" in run:
        return run
    length_s = run["frames"] * case.alter.every / case.flight.rate_hz
    times_s = (run.get("series") or {}).get("time_s") or []
    gap_s = np.max(np.diff([0.0, *times_s, max([length_s, *times_s])]))
    told: dict[str, Any] = {
        "gap_s": float(gap_s),
        "inside_95": (run.get("consistency") or {}).get("inside_95"),
    }
    if not run["localized"]:
        told["smoothed_m"] = None  # what a smoother then has is the pose it was given
    return run | told


def aggregate(runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Of one preset's runs over the seeds: statistics of each figure, and the runs themselves.

    `localized` is the share of the flight's frames, over all runs together.
    """
    good = [run for run in runs if "failed" not in run]
    frames = sum(run["frames"] for run in good)
    result: dict[str, Any] = {
        "runs": list(runs),
        "failed": [str(run["failed"]) for run in runs if "failed" in run],
        "accidents": [str(run["failed"]) for run in runs if run.get("accident")],
        "localized": sum(run["localized"] for run in good) / frames if frames else None,
        "landmarks": good[0]["landmarks"] if good else None,
        "keyframes": good[0]["keyframes"] if good else None,
        "stage_s": _median_of(good, "stage_s"),
        "consistency": _mean_of(good, "consistency"),
    }
    for name in FIGURES:
        result[name] = statistics([run.get(name) for run in good])
    return result


def statistics(values: Sequence[float | None]) -> dict[str, float | int] | None:
    """Mean, sample standard deviation, least and most of the finite ones; None without any."""
    numbers = [float(v) for v in values if v is not None and math.isfinite(v)]
    if not numbers:
        return None
    return {
        "mean": float(np.mean(numbers)),
        "std": float(np.std(numbers, ddof=1)) if len(numbers) > 1 else 0.0,
        "min": min(numbers),
        "max": max(numbers),
        "n": len(numbers),
    }


def _common(found: dict[str, list[dict[str, Any]]], presets: dict[str, Any]) -> None:
    """Adds `common_m` and `common_deg`: errors over the frames that both presets localized.

    A localizer that gives up when it gets hard has the smaller error over its own frames.
    """
    if set(found) != {"thesis", "default"}:
        return
    for key, name in (("common_m", "position_m"), ("common_deg", "rotation_deg")):
        values: dict[str, list[float | None]] = {preset: [] for preset in found}
        for pair in zip(*found.values(), strict=True):
            series = [run.get("series") or {"time_s": [], name: []} for run in pair]
            both = set(series[0]["time_s"]) & set(series[1]["time_s"])
            for preset, one in zip(found, series, strict=True):
                errors = [e for t, e in zip(one["time_s"], one[name], strict=True) if t in both]
                rmse = float(np.sqrt(np.mean(np.square(errors)))) if errors else None
                values[preset].append(rmse)
        for preset in found:
            presets[preset][key] = statistics(values[preset])


def worse(presets: dict[str, Any]) -> list[str]:
    """In what the default is not better than the thesis's method, in words; empty: in nothing."""
    if set(presets) != {"thesis", "default"}:
        return []
    theirs, ours = presets["thesis"], presets["default"]
    reasons = []
    if not (ours["localized"] or theirs["localized"] or ours["failed"] or theirs["failed"]):
        reasons.append("neither localizes a frame")
    if ours["failed"]:
        which = "both" if theirs["failed"] else "it"
        reasons.append(f"{which} failed: {ours['failed'][0]}")
    if not theirs["failed"] and (theirs["localized"] or 0) > (ours["localized"] or 0) + _COVERAGE:
        reasons.append(
            f"{100 * (ours['localized'] or 0):.1f} % of the frames are localized, by the thesis's "
            f"method {100 * theirs['localized']:.1f} %"
        )
    for name, common, unit, factor in (
        ("position_m", "common_m", " cm", 100.0),
        ("rotation_deg", "common_deg", "°", 1.0),
    ):
        # Over the frames of both, where that can be said: over its own, who gives up looks good.
        key = common if ours.get(common) and theirs.get(common) else name
        a, b = ours.get(key), theirs.get(key)
        if b is not None and (a is None or not a["mean"] < b["mean"]):
            told = "none" if a is None else f"{factor * a['mean']:.3f}{unit}"
            what = name.split("_")[0]
            reasons.append(
                f"{what} error {told}, the thesis's method {factor * b['mean']:.3f}{unit}"
            )
    return reasons


def _median_of(runs: Sequence[dict[str, Any]], key: str) -> dict[str, float]:
    names = dict.fromkeys(name for run in runs for name in run.get(key) or {})
    return {
        name: float(np.median([run[key][name] for run in runs if name in run[key]]))
        for name in names
    }


def _mean_of(runs: Sequence[dict[str, Any]], key: str) -> dict[str, float] | None:
    found = [run[key] for run in runs if run.get(key)]
    if not found:
        return None
    return {name: float(np.mean([one[name] for one in found])) for name in found[0]}
