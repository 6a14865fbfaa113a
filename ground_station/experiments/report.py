"""The report of experiments: one self-contained page, `results.json`, `results.md`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ground_station.experiments import pictures, tables
from ground_station.experiments.declaration import FLIGHT_S, IMAGES
from ground_station.experiments.summary import claim_line
from ground_station.files import write_json, write_text
from ground_station.map.floorplan import FloorPlan, load_floorplan
from ground_station.presentation.pages import Shown, shown, write_page
from ground_station.presentation.text import flat
from ground_station.presentation.text import markdown as markdown_table

_TEMPLATE = Path(__file__).parent / "templates" / "experiments.html"
QUICK = (
    f"Quick: one seed, the flights' first {FLIGHT_S:g} s and maps of at most {IMAGES} images, "
    "whatever a row is called; to see that all works."
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
    parts = [tables.verdict(document), document["conditions"] + quick, PRINTED]
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


def _pictures(experiment: dict[str, Any], atrium: FloorPlan | None) -> list[Shown]:
    cases = [
        c for c in experiment["cases"] if any(pictures.first_series(c, p) for p in c["presets"])
    ]
    if not cases:
        return []
    name = experiment["title"]
    found = []
    if experiment["level"]:
        level = experiment["level"]
        found.append(
            shown(f"Error over {level}", f"{name}: position error and share localized over {level}",
                  lambda theme: pictures.sweep(experiment["cases"], level, theme))
        )  # fmt: skip
    indoors = {case["flight"]["scene"] for case in cases if not case["flight"]["folder"]}
    plan = atrium if indoors == {"atrium"} else None
    if any(pictures.first_series(case, "default") for case in cases):
        found.append(
            shown("Paths, coloured by their error", f"{name}: paths from above, by error",
                  lambda theme: pictures.paths(cases, plan, theme))
        )  # fmt: skip
    found.append(
        shown("Error over time: preset thesis dashed, each frame alone dotted",
              f"{name}: position error over time",
              lambda theme: pictures.over_time(cases, theme))
    )  # fmt: skip
    found.append(
        shown("Share of frames within an error: preset thesis dashed, each frame alone dotted",
              f"{name}: distribution of the position error",
              lambda theme: pictures.distribution(cases, theme))
    )  # fmt: skip
    return found


def _setting(case: dict[str, Any]) -> tuple[str, str]:
    """A case and what it was made of, as one line of keys and values."""
    made_of = flat({table: case[table] for table in ("flight", "map", "alter", "localizer")})
    words = [f"{key} = {value}" for key, value in made_of.items() if value not in ("", 0, 0.0)]
    return str(case["title"]), "; ".join(words)
