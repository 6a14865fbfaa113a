"""README's table of the experiments: made of one accepted run, between two markers."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from ground_station.errors import InputError
from ground_station.experiments import declaration, tables
from ground_station.experiments.report import PRINTED
from ground_station.experiments.summary import reasons
from ground_station.files import finite, write_text
from ground_station.presentation.readme import Block
from ground_station.presentation.text import markdown

BLOCK = Block(
    "<!-- experiments: made by `blimp experiments --accept`; do not edit -->",
    "<!-- experiments: end -->",
)
NAME = "accepted.json"
"""Of the file beside `experiments.toml` that holds what README shows of the accepted run."""
_OF_EXPERIMENT = ("name", "title", "level", "date")
_OF_CASE = ("name", "title", "thesis", "worse")
_OF_PRESET = {
    "failed": None,
    "localized": None,
    "wrong": None,
    "registration_m": ("mean", "std", "n"),
    "position_m": ("mean", "std", "n"),
    "rotation_deg": ("mean", "std", "n"),
    "consistency": ("inside_95",),
}
"""The figures that the table shows, and what is kept of each; None: all of it."""


def render(document: dict[str, Any]) -> str:
    """The verdict, a table of all rows that are no levels, and one with a line for each series."""
    presets = tables.seen(document)
    names = [tables.NAMES[preset] for preset in presets]
    rows = [["experiment", "thesis's own*", *names, "inside 95 %"]]
    series = [["position error, over the frames localized", *names]]
    for e in document["experiments"]:
        if e["level"]:
            series.append([f"{e['title']} ({e['level']})", *(_levels(e, p) for p in presets)])
            continue
        for case in e["cases"]:
            title, printed = f"{e['title']}: {case['title']}", tables.printed(case)
            shown = [tables.figures(case, preset) for preset in presets]
            rows.append([title, printed, *shown, tables.inside(case)])
    parts = [markdown(table).rstrip() for table in (rows, series) if len(table) > 1]
    said = f"{document['conditions']} {_measured(document['experiments'])} {PRINTED}"
    return "\n\n".join([tables.verdict(document), *parts, said]) + "\n"


def accept(document: dict[str, Any], readme: Path, accepted: Path) -> None:
    """Makes a run the one that README shows, and keeps the figures that stand there.

    Experiments that are not of this run stay as they were accepted, with their date. A map that
    could not be built is a result. Raises `InputError` for a quick run, for one in which
    something was not measured or its process ended, and for a README without the markers.
    """
    if document["quick"]:
        raise InputError("a quick run is not what README shows; run them whole")
    for e in document["experiments"]:
        for case in e["cases"]:
            for preset, row in case["presets"].items():
                if row["accidents"]:
                    raise InputError(
                        f"{e['title']}, {case['title']}, {preset}: {row['accidents'][0]}; "
                        "such a run is not accepted"
                    )
    kept = shown(document)
    if accepted.is_file():
        kept = _with_others(kept, json.loads(accepted.read_text(encoding="utf-8")))
    BLOCK.write(readme, render(kept))
    # A line for each row: what changed from one run to the next can be read.
    lines = json.dumps(finite(kept), allow_nan=False).replace('{"name"', '\n{"name"')
    write_text(accepted, lines + "\n")


def shown(document: dict[str, Any]) -> dict[str, Any]:
    """What README's table and its check need of a run."""
    kept: dict[str, Any] = {
        key: document[key] for key in ("quick", "seeds", "conditions", "worse", "claims")
    }
    kept["experiments"] = [_part(e, _OF_EXPERIMENT) for e in document["experiments"]]
    for experiment, e in zip(kept["experiments"], document["experiments"], strict=True):
        experiment["cases"] = [
            _part(case, _OF_CASE)
            | {"presets": {preset: _figures(row) for preset, row in case["presets"].items()}}
            for case in e["cases"]
        ]
    return kept


def _with_others(kept: dict[str, Any], before: dict[str, Any]) -> dict[str, Any]:
    """A run's figures with those experiments' that only an earlier one of the same seeds had."""
    measured = {e["name"]: e for e in kept["experiments"]}
    names = {e["name"] for e in before["experiments"]}
    if names <= measured.keys() or before["seeds"] != kept["seeds"]:
        return kept
    experiments = [measured.get(e["name"], e) for e in before["experiments"]]
    experiments += [e for name, e in measured.items() if name not in names]
    declared = [e.name for e in declaration.load().experiments]
    if all(e["name"] in declared for e in experiments):  # else of a file of one's own
        experiments.sort(key=lambda e: declared.index(e["name"]))
    claims = {claim["text"]: claim for claim in before["claims"] + kept["claims"]}
    return kept | {
        "worse": reasons(experiments),
        "claims": list(claims.values()),
        "experiments": experiments,
    }


def _measured(experiments: Iterable[dict[str, Any]]) -> str:
    """On which day which experiments were, the latest first."""
    by_date: dict[str, list[str]] = {}
    for e in experiments:
        by_date.setdefault(e["date"], []).append(e["title"])
    *later, (first, _) = sorted(by_date.items(), reverse=True)
    if not later:
        return f"Measured on {first}."
    told = "; ".join(f"on {date}: {', '.join(titles)}" for date, titles in later)
    return f"Measured {told}; all else on {first}."


def _figures(row: dict[str, Any]) -> dict[str, Any]:
    return {
        name: row[name] if parts is None or row[name] is None else _part(row[name], parts)
        for name, parts in _OF_PRESET.items()
    }


def _part(table: dict[str, Any], names: Iterable[str]) -> dict[str, Any]:
    return {name: table[name] for name in names}


def _levels(experiment: dict[str, Any], preset: str) -> str:
    return "; ".join(
        f"{case['title']}: {tables.in_short(case, preset)}" for case in experiment["cases"]
    )
