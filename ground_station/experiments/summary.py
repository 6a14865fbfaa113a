"""From runs to tables: mean and spread over the seeds, and where ours is not the better one.

What the project says of itself is held against a run's figures, too.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from ground_station.experiments.declaration import FIGURES, Case, Claim, Declaration
from ground_station.experiments.plan import Plan
from ground_station.experiments.store import Store

CONDITIONS = (
    "Simulated flights, seeds {}, unless real video is named; all localize the same frames (alone "
    "every fifth of a simulated flight, which says as much), and only the preset thesis is told "
    "where it starts; errors are unaligned RMSE over the frames that were localized, mean ± "
    "standard deviation over the seeds."
)
RIVALS = {"thesis": "the thesis's method", "alone": "each frame alone"}
"""What the default is held against, and how it is called in a sentence."""
_SHARE = 0.005
"""A smaller share localized by more than this is worse."""
AS_GOOD = 0.02
"""An error that is larger by no more than this share is as good: one registration moves both."""


def summarise(
    declaration: Declaration, plan: Plan, store: Store, about: dict[str, Any]
) -> dict[str, Any]:
    """The document of `results.json`, `series` and all; `about`, with its `machine`, as it is."""
    experiments: list[dict[str, Any]] = []
    for experiment in declaration.experiments:
        cases = [_case(case, plan, store) for case in experiment.cases]
        experiments.append(
            {
                "name": experiment.name,
                "title": experiment.title,
                "question": experiment.question,
                "thesis_source": experiment.thesis_source,
                "thesis_times": asdict(experiment.thesis_times),
                "level": experiment.level,
                "date": about["machine"]["date"],
                "cases": cases,
            }
        )
    return about | {
        "seeds": list(declaration.seeds),
        "conditions": CONDITIONS.format(", ".join(map(str, declaration.seeds))),
        "worse": reasons(experiments),
        "claims": judge_claims(declaration.claims, experiments),
        "experiments": experiments,
    }


def reasons(experiments: Sequence[dict[str, Any]]) -> list[str]:
    """In which rows the default is the worse one, and by what."""
    return [
        f"{e['title']}, {c['title']}: {reason}"
        for e in experiments
        for c in e["cases"]
        for reason in c["worse"]
    ]


def _case(case: Case, plan: Plan, store: Store) -> dict[str, Any]:
    found = {
        preset: [_with_derived(store.read(key), case) for key in keys]
        for preset, keys in plan.runs[case.experiment, case.name].items()
    }
    presets = {preset: aggregate(runs) for preset, runs in found.items()}
    common = _common(found)
    return {
        "name": case.name,
        "title": case.title,
        "thesis": {k: v for k, v in asdict(case.thesis).items() if v not in (None, "")},
        "map": asdict(case.map),
        "flight": asdict(case.flight),
        "alter": dict(case.alter),
        "localizer": dict(case.localizer),
        "presets": presets,
        "common": common,
        "cause": case.cause,
        "worse": elsewhere(presets) if case.flight.storey_m else worse(presets, common),
    }


def _with_derived(run: dict[str, Any] | None, case: Case) -> dict[str, Any]:
    """A run with what is derived from it; or that it was not measured.

    `gap_s` is the longest time without a pose, the flight's ends included, and its whole length
    where no frame was localized; `inside_95` the share of poses whose errors fit their covariance.
    """
    if run is None:
        return {"failed": NOT_MEASURED, "accident": True}
    if "failed" in run:
        return run
    length_s = run["captured"] / case.flight.rate_hz
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
        "wrong": sum(run["wrong"] for run in good),
        "landmarks": good[0]["landmarks"] if good else None,
        "keyframes": good[0]["keyframes"] if good else None,
        "stage_s": _over(good, "stage_s", np.median),
        "consistency": _over(good, "consistency", np.mean) or None,
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


def _common(found: dict[str, list[dict[str, Any]]]) -> dict[str, Any]:
    """By rival: statistics `ours` and `theirs` of errors over the frames that both localized, and
    the shares localized of the frames that the rival saw, None where there were none.

    A localizer that gives up when it gets hard has the smaller error over its own frames.
    """
    result: dict[str, Any] = {}
    for rival in (name for name in RIVALS if {name, "default"} <= found.keys()):
        pairs = [*zip(found["default"], found[rival], strict=True)]
        result[rival] = {"localized": _shares(pairs)}
        for name in ("position_m", "rotation_deg"):
            values: dict[str, list[float | None]] = {"ours": [], "theirs": []}
            for pair in pairs:
                series = [run.get("series") or {"time_s": [], name: []} for run in pair]
                both = set(series[0]["time_s"]) & set(series[1]["time_s"])
                for whose, one in zip(values, series, strict=True):
                    errors = [e for t, e in zip(one["time_s"], one[name], strict=True) if t in both]
                    rmse = float(np.sqrt(np.mean(np.square(errors)))) if errors else None
                    values[whose].append(rmse)
            result[rival][name] = {whose: statistics(v) for whose, v in values.items()}
    return result


def _shares(pairs: Sequence[tuple[dict[str, Any], dict[str, Any]]]) -> dict[str, float] | None:
    seen, localized = 0, [0, 0]
    for pair in pairs:
        times = set(pair[1].get("seen_s", ()))
        seen += len(times)
        for k, run in enumerate(pair):
            localized[k] += len(times & {*(run.get("series") or {"time_s": ()})["time_s"]})
    return {"ours": localized[0] / seen, "theirs": localized[1] / seen} if seen else None


def elsewhere(presets: dict[str, Any]) -> list[str]:
    """In what the default is worse where the map has nothing of the flight, and all poses are
    wrong.
    """
    ours = presets.get("default")
    if ours is None:
        return []
    if ours["failed"]:
        return [f"it failed: {ours['failed'][0]}"]
    return [
        f"{100 * ours['localized']:.1f} % of the frames are localized where none can be, "
        f"{said} {100 * theirs['localized']:.1f} %"
        for name, said in RIVALS.items()
        if (theirs := presets.get(name)) and not theirs["failed"]
        if ours["localized"] > theirs["localized"]
    ]


def worse(presets: dict[str, Any], common: dict[str, Any]) -> list[str]:
    """In what the default is worse than each rival, in words; empty: in nothing."""
    rivals = {name: presets[name] for name in RIVALS if name in presets}
    ours = presets.get("default")
    if ours is None or not rivals:
        return []
    reasons = []
    if ours["failed"]:
        which = "all" if all(theirs["failed"] for theirs in rivals.values()) else "it"
        reasons.append(f"{which} failed: {ours['failed'][0]}")
    elif not ours["localized"]:
        reasons.append("no frame is localized")
    for name, theirs in rivals.items():
        said = RIVALS[name]
        shares = common[name]["localized"]
        if shares and not theirs["failed"] and shares["theirs"] > shares["ours"] + _SHARE:
            reasons.append(
                f"{100 * shares['ours']:.1f} % of the frames are localized, {said} "
                f"{100 * shares['theirs']:.1f} %"
            )
        for key, unit, factor in (("position_m", " cm", 100.0), ("rotation_deg", "°", 1.0)):
            # Over the frames of both, where that can be said: who gives up looks good over its own.
            pair = common[name][key]
            a, b = pair["ours"], pair["theirs"]
            if a is None or b is None:
                a, b = ours.get(key), theirs.get(key)
            if b is not None and (a is None or not a["mean"] <= (1 + AS_GOOD) * b["mean"]):
                told = "none" if a is None else f"{factor * a['mean']:.3f}{unit}"
                what = key.split("_")[0]
                reasons.append(f"{what} error {told}, {said} {factor * b['mean']:.3f}{unit}")
    return reasons


def _over(
    runs: Sequence[dict[str, Any]], key: str, statistic: Callable[..., Any]
) -> dict[str, float]:
    """A statistic of each figure in a run's table `key`, over the runs that have it."""
    tables = [run.get(key) or {} for run in runs]
    return {
        name: float(statistic([table[name] for table in tables if name in table]))
        for name in dict.fromkeys(name for table in tables for name in table)
    }


NOT_MEASURED = "not measured"
_UNITS = {"m": " m", "deg": "°", "s": " s", "95": ""}
"""By the end of a figure's name."""
_OVER_RUNS: dict[str, Callable[..., Any]] = {
    "mean": np.mean, "min": min, "max": max, "median": np.median,
    "p95": lambda values: np.percentile(values, 95),
}  # fmt: skip


def judge_claims(
    claims: Sequence[Claim], experiments: Sequence[dict[str, Any]]
) -> list[dict[str, Any]]:
    """Each claim with its figure, as plain values; `kept` is None where no run tells.

    A run without the figure, whose recovery never came or for which no map could be made, is worse
    than any that has it. Claims of experiments that were not wanted are left out.
    """
    cases = {f"{e['name']}.{c['name']}": [c] for e in experiments for c in e["cases"]}
    cases |= {e["name"]: e["cases"] for e in experiments}
    found = []
    for claim in claims:
        named = [row for row in (claim.row, claim.against) if row]
        if not all(row in cases for row in named):
            continue
        runs = [[run for case in cases[row] for run in _runs(case, claim)] for row in named]
        values = [_value(of, claim) for of in runs]
        value = values[0]
        if value is not None and claim.against:
            value = value / values[1] if values[1] else None
        measured = all(of and not any(run.get("accident") for run in of) for of in runs)
        kept = value is not None and _within(value, claim) if measured else None
        unit = " times" if claim.against else _UNITS[claim.figure.rpartition("_")[2]]
        found.append({"text": claim.text, "value": value, "most": claim.most, "least": claim.least,
                      "kept": kept, "unit": unit})  # fmt: skip
    return found


def claim_line(claim: dict[str, Any]) -> str:
    """A claim and what was measured, in a sentence."""
    if claim["kept"] is None:
        return f"{claim['text']}: {NOT_MEASURED}."
    unit = claim["unit"]
    told = "no figure in some run" if claim["value"] is None else f"{claim['value']:.3g}{unit}"
    word = "kept" if claim["kept"] else "not kept"
    side, bound = ("most", claim["most"]) if claim["least"] is None else ("least", claim["least"])
    return f"{claim['text']}: {word}, {told} (at {side} {bound:g}{unit})."


def _runs(case: dict[str, Any], claim: Claim) -> list[dict[str, Any]]:
    return list(case["presets"].get(claim.preset, {"runs": []})["runs"])


def _value(runs: Sequence[dict[str, Any]], claim: Claim) -> float | None:
    """None where a run that has no such figure decides it."""
    worst = math.inf if claim.least is None else -math.inf
    numbers = [worst if (v := run.get(claim.figure)) is None else v for run in runs]
    with np.errstate(invalid="ignore"):
        value = float(_OVER_RUNS[claim.statistic](numbers)) if numbers else math.nan
    return value if math.isfinite(value) else None


def _within(value: float, claim: Claim) -> bool:
    above = claim.least is None or value >= claim.least
    return above and (claim.most is None or value <= claim.most)
