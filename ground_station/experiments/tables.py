"""Experiments as tables: cells of text, from which the page, the console and Markdown are made."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ground_station.experiments.summary import AS_GOOD, claim_line
from ground_station.presentation.text import columns

NONE = "–"
NAMES = {"thesis": "preset thesis", "alone": "each frame alone", "default": "default"}

_LEAST_INSIDE = 0.9
_ALL = 0.995
"""A share localized that is shown as 100 %."""

Cell = Callable[[dict[str, Any]], str]


def every(experiment: dict[str, Any]) -> list[list[list[str]]]:
    """The tables of an experiment: errors, what else was asked, times; none without a figure."""
    return [table for table in (_errors(experiment), _further(experiment), _times(experiment))
            if table]  # fmt: skip


def _errors(experiment: dict[str, Any]) -> list[list[str]]:
    """All that localize beside what the thesis printed."""
    head: list[tuple[str, Cell]] = [("thesis's own*", printed)]
    for preset, name in NAMES.items():
        head += [
            (f"{name}: position", _spread(preset, "position_m", 100.0, " cm")),
            ("rotation", _spread(preset, "rotation_deg", 1.0, "°")),
            ("localized", _localized(preset)),
        ]
    return _of_cases(experiment, head)


def _further(experiment: dict[str, Any]) -> list[list[str]]:
    """Of the default, where nothing else is said."""
    return _of_cases(
        experiment,
        [
            ("on frames of thesis and default", _both("thesis")),
            ("alone and default", _both("alone")),
            ("smoothed", _spread("default", "smoothed_m", 100.0, " cm")),
            ("registration's share", _registration),
            ("inside 95 %", inside),
            ("wrong TRACKING, frames", wrong),
            ("found at first after", _spread("default", "first_s", 1.0, " s")),
            ("found again after", _spread("default", "recovery_s", 1.0, " s")),
            ("ms a frame", _time),
            ("landmarks", _landmarks),
        ],
    )


def _of_cases(experiment: dict[str, Any], head: list[tuple[str, Cell]]) -> list[list[str]]:
    """A row for each case; a column only where some case has a figure."""
    cases = experiment["cases"]
    rows = [[cell(case) for _, cell in head] for case in cases]
    used = [k for k in range(len(head)) if any(row[k] != NONE for row in rows)]
    if not used:
        return []
    lines = [[title for title, _ in head], *rows]
    first = [experiment["level"] or "case", *(str(case["title"]) for case in cases)]
    return [[name, *(line[k] for k in used)] for name, line in zip(first, lines, strict=True)]


def _times(experiment: dict[str, Any]) -> list[list[str]]:
    """Head and rows of where a frame's time went, beside what the thesis printed; [] if nothing."""
    printed = experiment["thesis_times"]
    if not any(printed.values()):
        return []
    runs = [
        (f"{case['title']}, {name}", case["presets"][preset]["stage_s"])
        for case in experiment["cases"]
        for preset, name in NAMES.items()
        if preset in case["presets"]
    ]
    head = ["median of a frame, s", "thesis's own*", *(title for title, _ in runs)]
    rows = [
        [stage, text or NONE, *(f"{of[stage]:.4f}" if stage in of else NONE for _, of in runs)]
        for stage, text in printed.items()
    ]
    return [head, *rows]


def seen(document: dict[str, Any]) -> list[str]:
    """Which presets some row has, in their order."""
    cases = [case for e in document["experiments"] for case in e["cases"]]
    return [preset for preset in NAMES if any(preset in case["presets"] for case in cases)]


def text(experiment: dict[str, Any]) -> str:
    """The tables for a console."""
    lines = ["  " + line for table in every(experiment) for line in columns(table)]
    return "\n".join([experiment["title"], *lines])


def verdict(document: dict[str, Any]) -> str:
    """The first paragraph: where the default is not the better one, and claims that are not kept.

    Rows that were not compared are counted, so that silence says nothing.
    """
    cases = [case for e in document["experiments"] for case in e["cases"]]
    compared = [c for c in cases if "default" in c["presets"] and len(c["presets"]) > 1]
    names = [NAMES[preset] for preset in seen(document) if preset != "default"]
    rivals = " and ".join(f"the {name}" if name.startswith("preset") else name for name in names)
    not_better = [case for case in compared if case["worse"]]
    others = len(cases) - len(compared)
    if not compared:
        said = "Nothing was compared."
    elif not not_better:
        said = (
            f"In all {len(compared)} rows the default is better than {rivals} or as good (within "
            f"{100 * AS_GOOD:g} %) in position and rotation, and localizes no smaller share of the "
            "frames."
        )
    else:
        said = (
            f"In {len(not_better)} of {len(compared)} rows the default is worse than {rivals} (by "
            f"more than {100 * AS_GOOD:g} %)."
        )
    alone = [f"{others} more rows have one preset only."] if others else []
    broken = [claim_line(one) for one in document["claims"] if one["kept"] is False]
    return " ".join([said, *alone, *_wrong(document), *_covariance(document), *broken])


def worse(document: dict[str, Any]) -> list[list[str]]:
    """Head and rows: where the default is worse than a rival, by what, and why; [] if nowhere."""
    found = [
        [f"{e['title']}, {case['title']}", "; ".join(case["worse"]), case["cause"] or "not known"]
        for e in document["experiments"]
        for case in e["cases"]
        if case["worse"]
    ]
    return [["the default is worse in", "by", "because"], *found] if found else []


def _default(document: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    """The default's figures by the name of their row."""
    rows = [(f"{e['title']}, {c['title']}", c["presets"].get("default"))
            for e in document["experiments"] for c in e["cases"]]  # fmt: skip
    return [(name, row) for name, row in rows if row is not None]


def _wrong(document: dict[str, Any]) -> list[str]:
    """In how many frames of all runs the default was sure and far off."""
    found = _default(document)
    if not found:
        return []
    rows = [(name, row["wrong"]) for name, row in found if row["wrong"]]
    where = "" if not rows else f": {'; '.join(f'{name}: {count}' for name, count in rows)}"
    total = sum(count for _, count in rows)
    return [f"TRACKING and further off than 0.25 m or 3° in {total} frames of all runs{where}."]


def _covariance(document: dict[str, Any]) -> list[str]:
    """The share of poses inside their 95 % ellipsoid, the worst rows first."""
    rows = sorted((found["inside_95"], name) for name, row in _default(document)
                  if (found := row["consistency"]) is not None)  # fmt: skip
    if not rows:
        return []
    low = [(share, name) for share, name in rows if share < _LEAST_INSIDE]
    worst = "; ".join(f"{name}: {100 * share:.0f} %" for share, name in low or rows[:1])
    rest = "of the poses lie inside their 95 % ellipsoid"
    if not low:
        return [f"In every row 90 % and more {rest} (least in {worst})."]
    return [f"In {len(low)} of {len(rows)} rows less than 90 % {rest}: {worst}."]


def printed(case: dict[str, Any]) -> str:
    """What the thesis printed of a row."""
    thesis = case["thesis"]
    parts = []
    if "position_m" in thesis:
        parts.append(f"{100 * thesis['position_m']:.1f} cm")
    if "rotation_deg" in thesis:
        parts.append(f"{thesis['rotation_deg']:.3f}°")
    if "note" in thesis:
        parts.append(str(thesis["note"]))
    return ", ".join(parts) or NONE


def figures(case: dict[str, Any], preset: str) -> str:
    """Position, rotation and share localized of one preset in one cell."""
    if preset not in case["presets"]:
        return NONE
    position = _spread(preset, "position_m", 100.0, " cm")(case)
    if position == NONE:
        return "no map" if case["presets"][preset]["failed"] else "no frame localized"
    rotation = _spread(preset, "rotation_deg", 1.0, "°")(case)
    share = _registration(case) if preset == "default" else NONE
    of_it = "" if share == NONE else f" ({share} registration's)"
    return f"{position}{of_it}, {rotation}, {_localized(preset)(case)} localized"


def in_short(case: dict[str, Any], preset: str) -> str:
    """Mean position error of one preset, and its share localized where that is not all."""
    row = case["presets"].get(preset, {})
    found = row.get("position_m")
    if found is None:
        return NONE
    share = "" if row["localized"] > _ALL else f" of {100 * row['localized']:.0f} %"
    return f"{100 * found['mean']:.1f} cm{share}"


def _spread(preset: str, key: str, factor: float, unit: str) -> Cell:
    def cell(case: dict[str, Any]) -> str:
        found = case["presets"].get(preset, {}).get(key)
        if found is None:
            return NONE
        mean, std = factor * found["mean"], factor * found["std"]
        return f"{mean:.2f} ± {std:.2f}{unit}" if found["n"] > 1 else f"{mean:.2f}{unit}"

    return cell


_registration = _spread("default", "registration_m", 100.0, " cm")


def _localized(preset: str) -> Cell:
    def cell(case: dict[str, Any]) -> str:
        row = case["presets"].get(preset)
        if row is None:
            return NONE
        if row["failed"] and row["localized"] is None:
            return "failed"
        return NONE if row["localized"] is None else f"{100 * row['localized']:.1f} %"

    return cell


def _both(rival: str) -> Cell:
    def cell(case: dict[str, Any]) -> str:
        pair = case["common"].get(rival, {}).get("position_m", {})
        found = [pair.get(whose) for whose in ("theirs", "ours")]
        if None in found:
            return NONE
        theirs, ours = (100 * one["mean"] for one in found)
        return f"{theirs:.2f} → {ours:.2f} cm"

    return cell


def wrong(case: dict[str, Any]) -> str:
    """The default's frames that are TRACKING and far off, over all runs."""
    found = case["presets"].get("default", {})
    return str(found["wrong"]) if found.get("landmarks") else NONE


def inside(case: dict[str, Any]) -> str:
    """Share of the default's poses that lie inside their 95 % ellipsoid."""
    found = case["presets"].get("default", {}).get("consistency")
    return NONE if found is None else f"{100 * found['inside_95']:.1f} %"


def _time(case: dict[str, Any]) -> str:
    found = [case["presets"].get(p, {}).get("stage_s", {}).get("total") for p in NAMES]
    shown = [f"{1e3 * value:.0f}" for value in found if value is not None]
    return " → ".join(shown) or NONE


def _landmarks(case: dict[str, Any]) -> str:
    found = next((row["landmarks"] for row in case["presets"].values() if row["landmarks"]), None)
    return NONE if found is None else f"{found:,}".replace(",", " ")
