"""README's table of the experiments: made of one accepted run, between two markers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ground_station.errors import GroundStationError, InputError
from ground_station.experiments import tables
from ground_station.experiments.report import PRINTED, conditions
from ground_station.files import write_json, write_text

BEGIN = "<!-- experiments: made by `blimp experiments --accept`; do not edit -->"
END = "<!-- experiments: end -->"
NAME = "accepted.json"
"""Of the file beside `experiments.toml` that holds the run which README shows."""


def render(document: dict[str, Any]) -> str:
    """The verdict, a table of all rows that are no levels, and one with a line for each series."""
    rows = [["experiment", "thesis's own*", *tables.NAMES.values(), "inside 95 %"]]
    series = [["position error, over the frames localized", *tables.NAMES.values()]]
    for e in document["experiments"]:
        if e["level"]:
            series.append([f"{e['title']} ({e['level']})", *(_levels(e, p) for p in tables.NAMES)])
            continue
        for case in e["cases"]:
            title, printed = f"{e['title']}: {case['title']}", tables.printed(case)
            rows.append([title, printed, *_presets(case), tables.inside(case)])
    parts = [tables.markdown(table).rstrip() for table in (rows, series) if len(table) > 1]
    said = f"{conditions(document)} {PRINTED}"
    return "\n\n".join([tables.verdict(document), *parts, said]) + "\n"


def table_in(readme: str) -> str | None:
    """What stands between the markers; None without them."""
    if BEGIN not in readme or END not in readme:
        return None
    return readme.split(BEGIN, 1)[1].split(END, 1)[0].strip("\n") + "\n"


def accept(document: dict[str, Any], readme: Path, accepted: Path) -> None:
    """Makes a run the one that README shows, and keeps its figures without the single frames.

    A map that could not be built is a result. Raises `InputError` for a quick run, for one in which
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
    text = readme.read_text()
    if table_in(text) is None:
        raise InputError(f"{readme}: has no line '{BEGIN}' with '{END}' after it")
    before, rest = text.split(BEGIN, 1)
    after = rest.split(END, 1)[1]
    write_json(accepted, without_frames(document))
    write_text(readme, f"{before}{BEGIN}\n{render(document)}{END}{after}")


def without_frames(document: dict[str, Any]) -> dict[str, Any]:
    """The same without the runs one by one: what a table needs."""
    return document | {
        "experiments": [
            e
            | {
                "cases": [
                    case
                    | {
                        "presets": {
                            preset: {k: v for k, v in row.items() if k != "runs"}
                            for preset, row in case["presets"].items()
                        }
                    }
                    for case in e["cases"]
                ]
            }
            for e in document["experiments"]
        ]
    }


def read(path: Path) -> dict[str, Any]:
    """An accepted run; raises `GroundStationError` where it is none."""
    try:
        document = json.loads(path.read_text())
        if not isinstance(document["experiments"], list):
            raise ValueError("no experiments")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise GroundStationError(f"{path}: {error}") from None
    return dict(document)


def _levels(experiment: dict[str, Any], preset: str) -> str:
    return "; ".join(
        f"{case['title']}: {tables.in_short(case, preset)}" for case in experiment["cases"]
    )


def _presets(case: dict[str, Any]) -> list[str]:
    return [tables.figures(case, preset) for preset in tables.NAMES]
