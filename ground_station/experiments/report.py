"""The report of experiments: a self-contained page, `results.json`, `results.md`, README's table.

The table is made of one accepted run and stands between two markers.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from ground_station.errors import InputError
from ground_station.experiments import declaration, pictures, tables
from ground_station.experiments.declaration import FLIGHT_S, IMAGES
from ground_station.experiments.summary import claim_line, reasons
from ground_station.files import finite, write_json, write_text
from ground_station.map.floorplan import FloorPlan, load_floorplan
from ground_station.presentation.pages import ThemedFigure, themed_figure, write_page
from ground_station.presentation.readme import Block
from ground_station.presentation.text import flat
from ground_station.presentation.text import markdown as markdown_table
from ground_station.presentation.theme import Theme

_TEMPLATE = Path(__file__).parent / "templates" / "experiments.html"
QUICK = (
    f"Quick: one seed, the flights' first {FLIGHT_S:g} s at half their rate and maps of at most "
    f"{IMAGES} images, whatever a row is called; to see that all works. So short a flight leaves "
    "some eight frames to each frame alone: what is a millimetre worse than it may be no worse."
)
PRINTED = (
    "* as the thesis printed it: another building, another camera. No ratio is taken against it."
)


def write(document: dict[str, Any], out: Path, floorplan: Path | None = None) -> None:
    """Writes `results.json`, `results.md` and `report.html` into the folder `out`.

    `floorplan` is the plan of the simulated atrium, a floorplan.yaml.
    """
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / "results.json", document)
    write_text(out / "results.md", markdown(document))
    plan = load_floorplan(floorplan) if floorplan is not None else None
    experiments = [
        {
            "head": e,
            "tables": tables.every(e),
            "pictures": _pictures(e, plan),
            "settings": [_setting(case) for case in e["cases"]],
            "failed": [
                f"{case['title']}, {tables.NAMES[preset]}: {reason}"
                for case in e["cases"]
                for preset, row in case["presets"].items()
                for reason in dict.fromkeys(row["failed"])
            ],
        }
        for e in document["experiments"]
    ]
    write_page(
        out / "report.html",
        _TEMPLATE,
        title="The experiments of the thesis, flown again",
        verdict=tables.verdict(document),
        worse=tables.worse(document),
        good=good(document),
        claims=[claim_line(claim) for claim in document["claims"]],
        document=document,
        experiments=experiments,
        printed=PRINTED,
        quick=QUICK if document["quick"] else "",
    )


def markdown(document: dict[str, Any]) -> str:
    """All tables, after the verdict."""
    quick = f" {QUICK}" if document["quick"] else ""
    worse = markdown_table(tables.worse(document)) if document["worse"] else ""
    parts = [tables.verdict(document), worse, document["conditions"] + quick, PRINTED]
    parts += ["\n".join(f"- {claim_line(claim)}" for claim in document["claims"])]
    for experiment in document["experiments"]:
        title = f"### {experiment['title']}"
        question = experiment["question"]
        parts.append(title + (f"\n\n{question}" if question else ""))
        parts += [markdown_table(table) for table in tables.every(experiment)]
    return "\n\n".join(part.strip("\n") for part in parts if part) + "\n"


def good(document: dict[str, Any]) -> bool:
    """Whether the default is the better one in all rows and no claim is broken."""
    return not document["worse"] and all(c["kept"] is not False for c in document["claims"])


def _pictures(experiment: dict[str, Any], atrium: FloorPlan | None) -> list[ThemedFigure]:
    cases = [
        c for c in experiment["cases"] if any(pictures.first_series(c, p) for p in c["presets"])
    ]
    if not cases:
        return []
    level, title = experiment["level"], experiment["title"]
    indoors = {case["flight"]["scene"] for case in cases if not case["flight"]["folder"]}
    plan = atrium if indoors == {"atrium"} else None
    drawn: list[tuple[str, str, Callable[[Theme], Figure]]] = []
    if level:
        drawn.append((f"Error over {level}", f"position error and share localized over {level}",
                      lambda theme: pictures.sweep(experiment["cases"], level, theme)))  # fmt: skip
    if any(pictures.first_series(case, "default") for case in cases):
        drawn.append(("Paths, coloured by their error", "paths from above, by error",
                      lambda theme: pictures.paths(cases, plan, theme)))  # fmt: skip
    styles = "preset thesis dashed, each frame alone dotted"
    drawn += [
        (f"Error over time: {styles}", "position error over time",
         lambda theme: pictures.over_time(cases, theme)),
        (f"Share of frames within an error: {styles}", "distribution of the position error",
         lambda theme: pictures.distribution(cases, theme)),
    ]  # fmt: skip
    return [themed_figure(heading, f"{title}: {words}", draw) for heading, words, draw in drawn]


def _setting(case: dict[str, Any]) -> tuple[str, str]:
    """A case and what it was made of, as one line of keys and values."""
    made_of = flat({table: case[table] for table in ("flight", "map", "alter", "localizer")})
    words = [f"{key} = {value}" for key, value in made_of.items() if value not in ("", 0, 0.0)]
    return str(case["title"]), "; ".join(words)


BLOCK = Block(
    "<!-- experiments: made by `blimp experiments --accept`; do not edit -->",
    "<!-- experiments: end -->",
)
ACCEPTED = "accepted.json"
"""Of the file beside `experiments.toml` that holds what README shows of the accepted run."""
_OF_EXPERIMENT = ("name", "title", "level", "date")
_OF_CASE = ("name", "title", "thesis", "worse", "cause")
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
    shown_tables = (tables.worse(document), rows, series)
    parts = [markdown_table(table).rstrip() for table in shown_tables if len(table) > 1]
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
    kept = _kept(document)
    if accepted.is_file():
        kept = _with_others(kept, json.loads(accepted.read_text(encoding="utf-8")))
    BLOCK.write(readme, render(kept))
    # A line for each row: what changed from one run to the next can be read.
    lines = json.dumps(finite(kept), allow_nan=False).replace('{"name"', '\n{"name"')
    write_text(accepted, lines + "\n")


def _kept(document: dict[str, Any]) -> dict[str, Any]:
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
