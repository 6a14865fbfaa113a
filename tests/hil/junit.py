"""A judged suite for machines: JUnit XML, which CI systems read, and JSON with everything."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import msgspec

from ground_station.evaluation.figures import Row
from ground_station.files import write_bytes, write_json
from ground_station.replay.cases.judge import Judged

_FORBIDDEN = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""What XML 1.0 (2.2) has no way to say."""


def write_junit(path: str | Path, name: str, cases: Sequence[Judged], *, began: str) -> None:
    """Writes one test suite a case, one test a row that was asked for; `began` is ISO 8601.

    A case that could not be flown has the one test `flown`, with an error; one that was skipped,
    with why.
    """
    root = ElementTree.Element("testsuites", {"name": text(name)})
    for case in cases:
        root.append(_suite(case, began))
    for key in ("tests", "failures", "errors", "skipped"):
        root.set(key, str(sum(int(suite.get(key, "0")) for suite in root)))
    root.set("time", f"{sum(case.seconds for case in cases):.3f}")
    ElementTree.indent(root)
    data = ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)
    write_bytes(path, data + b"\n")


def write_suite_json(
    path: str | Path, name: str, cases: Sequence[Judged], *, began: str, **more: Any
) -> None:
    """Writes the same with every figure, what made it, and whatever else is given."""
    document = {
        "schema": "blimp.suite/1",
        "name": name,
        "began": began,
        "passed": bool(cases) and all(case.passed for case in cases),
        **more,
        "cases": [_document(case) for case in cases],
    }
    write_json(path, document)


def text(value: object) -> str:
    """Any text as XML can say it: a control character becomes a question mark."""
    return _FORBIDDEN.sub("?", str(value))


def _suite(case: Judged, began: str) -> ElementTree.Element:
    asked = [row for row in case.rows if row.holds is not None]
    suite = ElementTree.Element("testsuite", {"name": text(f"{case.name} ({case.payload})")})
    properties = ElementTree.SubElement(suite, "properties")
    for key, value in _properties(case):
        ElementTree.SubElement(properties, "property", {"name": text(key), "value": text(value)})
    group = text(f"hil.{case.payload}.{case.name}")
    if case.error or case.skipped or not asked:
        test = ElementTree.SubElement(
            suite, "testcase", {"classname": group, "name": "flown", "time": f"{case.seconds:.3f}"}
        )
        if case.skipped:
            ElementTree.SubElement(test, "skipped", {"message": text(case.skipped)})
        else:
            why = text(case.error or "nothing was judged")
            ElementTree.SubElement(test, "error", {"message": why, "type": "error"}).text = why
    else:
        # A case takes its time once: at its first test.
        for number, row in enumerate(asked):
            seconds = case.seconds if number == 0 else 0.0
            suite.append(_test(row, group, seconds))
    tests = suite.findall("testcase")
    for key, tag in (("failures", "failure"), ("errors", "error"), ("skipped", "skipped")):
        suite.set(key, str(sum(test.find(tag) is not None for test in tests)))
    suite.set("tests", str(len(tests)))
    suite.set("time", f"{case.seconds:.3f}")
    suite.set("timestamp", text(began))
    if case.notes:
        ElementTree.SubElement(suite, "system-out").text = text("\n".join(case.notes))
    return suite


def _test(row: Row, group: str, seconds: float) -> ElementTree.Element:
    test = ElementTree.Element(
        "testcase", {"classname": group, "name": text(row.name), "time": f"{seconds:.3f}"}
    )
    if row.holds is False:
        why = text(told(row))
        ElementTree.SubElement(test, "failure", {"message": why, "type": "bound"}).text = why
    return test


def told(row: Row) -> str:
    """A row in one line: what was measured, what is allowed, and where from or why not."""
    parts = [row.measured, f"allowed: {row.allowed}" if row.allowed else "", row.told]
    return f"{row.name}: " + "; ".join(part for part in parts if part)


def _properties(case: Judged) -> list[tuple[str, object]]:
    found: list[tuple[str, object]] = [("title", case.title), ("payload", case.payload)]
    if case.outcome is not None:
        run = case.outcome.run
        found += [
            ("link", run.link),
            ("recording", run.recording),
            ("map", run.map),
            ("preset", run.preset),
            ("seed", run.seed),
            ("stepped", str(run.stepped).lower()),
            *((f"version.{name}", version) for name, version in run.versions.items()),
            *((f"frames.{name}", count) for name, count in asdict(run.accounts).items()),
        ]
    # What was measured and not judged is no test, and worth a place all the same.
    found += [(f"measured.{r.name}", r.measured) for r in case.rows if r.holds is None]
    return found


def _document(case: Judged) -> dict[str, Any]:
    outcome = case.outcome
    return {
        "name": case.name,
        "title": case.title,
        "payload": case.payload,
        "passed": case.passed,
        "error": case.error,
        "skipped": case.skipped,
        "seconds": case.seconds,
        "notes": case.notes,
        "rows": [asdict(row) for row in case.rows],
        "outcome": None if outcome is None else msgspec.to_builtins(outcome.run),
    }
