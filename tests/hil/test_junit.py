"""What machines read of a judged suite: valid XML whatever stands in a name, and every figure."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from xml.etree import ElementTree

import junit
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ground_station.replay.cases import judge
from ground_station.replay.cases.case import Limits
from ground_station.replay.cases.judge import Judged

sys.path.append(str(Path(__file__).parents[1] / "replay"))

import cases_stand as stand

BEGAN = "2026-03-14T10:00:00+00:00"


def suite() -> list[Judged]:
    run = stand.outcome(title="x")
    good = judge.rows(run, Limits(coverage_min=0.9), None)
    bad = judge.rows(run, Limits(position_rmse_m_max=0.1, coverage_min=0.5), None)
    return [
        Judged(
            "calm", "in calm air", "process", good, run, seconds=2.5, notes=["it was cut\x1b[1m"]
        ),
        Judged("lossy", "5 % <lost> & \x00\ud800", "process", bad, run, seconds=1.0),
        Judged("gone", "no board", "ssh", error="ssh: no route\x07"),
        Judged("later", "not here", "image", skipped="the image needs root"),
    ]


@pytest.fixture
def root(tmp_path: Path) -> ElementTree.Element:
    junit.write_junit(tmp_path / "j.xml", "replay tests", suite(), began=BEGAN)
    return ElementTree.parse(tmp_path / "j.xml").getroot()


def test_counts_are_of_the_tests_that_are_there(root: ElementTree.Element) -> None:
    """As readers check them: each suite's, and the sum of all."""
    assert root.tag == "testsuites"
    for element in (root, *root.findall("testsuite")):
        tests = element.findall(".//testcase")
        assert int(element.get("tests", "")) == len(tests) > 0
        for key, tag in (("failures", "failure"), ("errors", "error"), ("skipped", "skipped")):
            assert int(element.get(key, "")) == sum(t.find(tag) is not None for t in tests)
    assert (root.get("failures"), root.get("errors"), root.get("skipped")) == ("1", "1", "1")
    assert float(root.get("time", "")) == sum(float(s.get("time", "")) for s in root) == 3.5
    names = [(t.get("classname"), t.get("name")) for t in root.iter("testcase")]
    assert len(set(names)) == len(names) and all(a and b for a, b in names)


def test_elements_stand_in_the_order_that_readers_ask_for(root: ElementTree.Element) -> None:
    order = ["properties", "testcase", "system-out", "system-err"]
    for one in root.findall("testsuite"):
        places = [order.index(child.tag) for child in one]
        assert places == sorted(places) and places[0] == 0
        assert one.get("timestamp") == BEGAN


def test_a_missed_bound_is_a_failure_that_says_why(root: ElementTree.Element) -> None:
    test = root.find(".//testcase[@name='position_rmse_m_max']")
    assert test is not None and test.get("classname") == "hil.process.lossy"
    failure = test.find("failure")
    assert failure is not None and failure.get("message") == (
        "position_rmse_m_max: not measured; allowed: at most 0.1 m; this case has no truth"
    )
    error, skipped = root.find(".//error"), root.find(".//skipped")
    assert error is not None and error.get("message") == "ssh: no route?"
    assert skipped is not None and skipped.get("message") == "the image needs root"


def test_what_made_the_run_and_what_nobody_asked_are_properties(root: ElementTree.Element) -> None:
    one = root.find("testsuite[@name='lossy (process)']/properties")
    assert one is not None
    told = {p.get("name"): p.get("value") for p in one}
    assert told["title"] == "5 % <lost> & ??" and told["frames.sent"] == "60"
    assert told["measured.latency_p50_ms"] == "40 ms" and told["recording"] == "flight.mcap"
    out = root.find("testsuite[@name='calm (process)']/system-out")
    assert out is not None and out.text == "it was cut?[1m"


def test_a_case_of_which_nothing_was_judged_is_no_success(tmp_path: Path) -> None:
    junit.write_junit(tmp_path / "j.xml", "s", [Judged("a", "b", "process")], began=BEGAN)
    root = ElementTree.parse(tmp_path / "j.xml").getroot()
    assert root.get("errors") == "1"


@settings(deadline=None)
@given(st.text(st.characters(), max_size=40))
def test_any_text_is_xml_and_reads_back_without_what_xml_cannot_say(text: str) -> None:
    element = ElementTree.Element("a", {"b": junit.text(text)})
    read = ElementTree.fromstring(ElementTree.tostring(element, encoding="utf-8"))
    assert read.get("b") == junit.text(text) and len(junit.text(text)) == len(text)


def test_json_has_every_row_and_what_made_it(tmp_path: Path) -> None:
    junit.write_suite_json(tmp_path / "s.json", "replay tests", suite(), began=BEGAN, payload="x")
    told = json.loads((tmp_path / "s.json").read_text())
    assert told["passed"] is False and told["payload"] == "x" and len(told["cases"]) == 4
    lossy = told["cases"][1]
    row = next(r for r in lossy["rows"] if r["name"] == "position_rmse_m_max")
    assert row["holds"] is False and row["value"] is None and row["bound"] == 0.1
    assert lossy["outcome"]["accounts"]["sent"] == 60
    junit.write_suite_json(tmp_path / "s.json", "none", [], began=BEGAN)
    assert json.loads((tmp_path / "s.json").read_text())["passed"] is False
