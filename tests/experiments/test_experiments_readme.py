"""README's table is of an accepted run of the shipped experiments, and current."""

from __future__ import annotations

import json

import kept_runs
import pytest

from ground_station.errors import InputError
from ground_station.experiments import declaration, report

NEWER: set[str] = set()
"""Rows that are shipped, and newer than the accepted run; the next one empties this."""
ACCEPTED = declaration.SHIPPED.with_name(report.ACCEPTED)


@pytest.fixture
def document(tmp_path):
    """Of two experiments, one a series of levels."""
    text = (
        'seeds = [1]\n[experiment.light]\ntitle = "Light"\n[experiment.light.case.noon]\n'
        'thesis.position_m = 0.2\n[experiment.blur]\nlevel = "px"\n[experiment.blur.case.2]\n'
    )
    ours, theirs = kept_runs.run([0.01] * 3), kept_runs.run([0.1] * 3)
    lost = kept_runs.run([0.1, 0.1, None])
    runs = {
        ("light", "noon"): {"thesis": [theirs], "default": [ours]},
        ("blur", "2"): {"thesis": [lost], "default": [ours]},
    }
    return kept_runs.document(tmp_path, text, runs)


def test_an_accepted_run_stands_in_readme_and_only_its_figures_there_are_kept(tmp_path, document):
    page = tmp_path / "README.md"
    page.write_text(f"before\n{report.BLOCK.begin}\n{report.BLOCK.end}\nafter\n")
    report.accept(document, page, tmp_path / "accepted.json")
    text = page.read_text()
    assert text.startswith("before\n") and text.endswith("\nafter\n")
    kept = json.loads((tmp_path / "accepted.json").read_text())
    assert report.BLOCK.read(text) == report.render(kept) == report.render(document)
    assert "| Light: noon | 20.0 cm | 10.00 cm, 1.00°, 100.0 % localized | 1.00 cm" in text
    assert "100.0 % localized | 95.0 % |" in text  # of the default's poses, inside their 95 %
    assert "| blur (px) | 2: 10.0 cm of 67 % | 2: 1.0 cm |" in text
    assert "landmarks" not in (tmp_path / "accepted.json").read_text()
    report.accept(document, page, tmp_path / "accepted.json")
    assert page.read_text() == text


def test_experiments_that_a_run_has_not_stay_as_they_were_accepted(tmp_path, document):
    page, accepted = tmp_path / "README.md", tmp_path / "accepted.json"
    page.write_text(f"{report.BLOCK.begin}\n{report.BLOCK.end}\n")
    claim = {"value": 1.0, "most": 2.0, "least": None, "kept": True, "unit": " m"}
    told = [claim | {"text": "of the light"}, claim | {"text": "of blur"}]
    document["experiments"][0]["cases"][0]["worse"] = ["it is dark"]
    document["experiments"][1]["cases"][0]["worse"] = ["it is blurred"]
    report.accept(document | {"claims": told}, page, accepted)
    assert "Measured on 2026-11-27." in page.read_text()
    part = json.loads(json.dumps(document)) | {"claims": [told[0] | {"kept": False}]}
    del part["experiments"][1]
    light = part["experiments"][0]
    light["date"], light["cases"][0]["worse"] = "2026-11-28", ["it is darker"]
    report.accept(part, page, accepted)
    kept = json.loads(accepted.read_text())
    assert [e["name"] for e in kept["experiments"]] == ["light", "blur"]
    assert kept["worse"] == ["Light, noon: it is darker", "blur, 2: it is blurred"]
    assert [(c["text"], c["kept"]) for c in kept["claims"]] == [
        ("of the light", False), ("of blur", True),
    ]  # fmt: skip
    assert "Measured on 2026-11-28: Light; all else on 2026-11-27." in page.read_text()
    # Of other seeds, or whole, a run stands alone.
    report.accept(part | {"seeds": [7]}, page, accepted)
    assert [e["name"] for e in json.loads(accepted.read_text())["experiments"]] == ["light"]
    report.accept(document, page, accepted)
    assert "Measured on 2026-11-27." in page.read_text()


def test_what_was_not_measured_before_stands_where_it_is_declared(tmp_path, document):
    page, accepted = tmp_path / "README.md", tmp_path / "accepted.json"
    page.write_text(f"{report.BLOCK.begin}\n{report.BLOCK.end}\n")
    first, second = document["experiments"]
    first["name"], second["name"] = "illumination", "landmarks"
    report.accept(document, page, accepted)
    first["name"] = "people"
    report.accept(document | {"experiments": [first]}, page, accepted)
    names = [e["name"] for e in json.loads(accepted.read_text())["experiments"]]
    assert names == ["illumination", "people", "landmarks"]


def test_a_quick_or_failed_run_or_a_readme_without_markers_is_not_accepted(tmp_path, document):
    page, accepted = tmp_path / "README.md", tmp_path / "accepted.json"
    page.write_text("nothing")
    with pytest.raises(InputError, match="has no line"):
        report.accept(document, page, accepted)
    page.write_text(f"{report.BLOCK.begin}\n{report.BLOCK.end}\n")
    with pytest.raises(InputError, match="quick"):
        report.accept(document | {"quick": True}, page, accepted)
    broken = json.loads(json.dumps(document))
    row = broken["experiments"][0]["cases"][0]["presets"]["default"]
    row["failed"] = row["accidents"] = ["it ended each process that tried it"]
    with pytest.raises(
        InputError, match="Light, noon, default: it ended each process that tried it"
    ):
        report.accept(broken, page, accepted)
    assert not accepted.exists()


def test_a_map_that_could_not_be_built_is_a_result_and_stands_in_readme(tmp_path, document):
    page = tmp_path / "README.md"
    page.write_text(f"{report.BLOCK.begin}\n{report.BLOCK.end}\n")
    row = document["experiments"][0]["cases"][0]["presets"]["default"]
    row |= {"failed": ["no two images overlap"], "localized": None, "position_m": None}
    report.accept(document, page, tmp_path / "accepted.json")
    assert "| Light: noon | 20.0 cm | 10.00 cm, 1.00°, 100.0 % localized | no map |" in (
        page.read_text()
    )


def test_readme_shows_the_accepted_run_of_the_shipped_experiments_or_none():
    shown = report.BLOCK.read(declaration.SHIPPED.with_name("README.md").read_text())
    if shown is None:
        assert not ACCEPTED.exists()
        return
    accepted = json.loads(ACCEPTED.read_text())
    assert shown == report.render(accepted)
    declared = declaration.load()
    assert accepted["seeds"] == list(declared.seeds)
    names = [f"{e['name']}.{c['name']}" for e in accepted["experiments"] for c in e["cases"]]
    shipped = [f"{e.name}.{c.name}" for e in declared.experiments for c in e.cases]
    assert names == [name for name in shipped if name not in NEWER]
    assert set(shipped) >= NEWER
