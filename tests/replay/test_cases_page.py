"""The pages of a comparison and of a suite: strict, whole, and readable on a narrow screen."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cases_stand as stand
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from parsed_page import Page

from ground_station.geometry.trajectory import Trajectory
from ground_station.map.floorplan import FloorPlan
from ground_station.presentation.theme import DARK, LIGHT
from ground_station.replay.cases import judge, page, pictures
from ground_station.replay.cases.case import Limits
from ground_station.replay.cases.compare import compare
from ground_station.replay.cases.judge import Judged
from ground_station.replay.cases.outcome import Outage
from ground_station.replay.cases.truth import Reference

HOSTILE = "<script>alert(1)</script>'\" onload=x \x07\u202eevil\udcff"


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Path]]:
    """Both pages of two runs, the second of which went off, was lost and has hostile names."""
    folder = tmp_path_factory.mktemp("pages")
    rows = [stand.off(k, 0.004 * k) for k in range(60) if k not in (20, 21)]
    rows[30] = stand.row(32, state="LOST", wTc=None, reason=HOSTILE)
    begin_ns = stand.CLOCK_NS + 500_000_000
    plan = FloorPlan(np.full((40, 40), 255, np.uint8), 0.1, (0.0, 0.0, 0.0))
    a = dataclasses.replace(stand.outcome(versions={"v": "1"}), floorplan=plan)
    b = dataclasses.replace(
        stand.outcome(
            rows,
            title=HOSTILE,
            versions={HOSTILE: HOSTILE},
            notes=[HOSTILE],
            accounts={"captured": 60, "sent": 60, "lost": 2},
            outages=[Outage(begin_ns, begin_ns + 100_000_000, HOSTILE)],
        ),
        floorplan=plan,
    )
    comparison = compare(a, b)
    paths = {"compare": folder / "compare.html", "suite": folder / "suite.html"}
    page.write_comparison(paths["compare"], comparison, "before", HOSTILE)
    reference = Reference(stand.truth(), HOSTILE)
    judged = judge.rows(b, Limits(position_max_m=0.1, coverage_min=0.9), reference)
    cases = [
        Judged("far", HOSTILE, "process", judged, b, reference, 2.0, notes=[HOSTILE]),
        Judged(HOSTILE, "title", "ssh", error=HOSTILE),
        Judged("later", "title", "image", skipped=HOSTILE),
    ]
    page.write_suite(paths["suite"], "Replay tests", cases, began="2026-03-14T10:00:00+00:00")
    yield paths


@pytest.mark.parametrize(("name", "count"), [("compare", 3), ("suite", 2)])
def test_a_page_stands_alone_with_pictures_and_names_as_text(
    written: dict[str, Path], name: str, count: int
) -> None:
    text = written[name].read_text(encoding="utf-8")
    found = Page(text)
    found.assert_alone()
    assert found.pictures() == (count, count)
    assert "<script>alert(1)</script>'\" onload=x ??evil?" in found.words  # as text, and shown
    assert not any(not c.isprintable() and c != "\n" for c in text)


def test_what_got_worse_is_said_first(written: dict[str, Path]) -> None:
    words = " ".join(Page(written["compare"].read_text(encoding="utf-8")).words.split())
    said = "✗ B is worse than A: position_rmse_m, "
    assert said in words and words.index(said) < words.index("What got worse")
    assert "58 frames in both, 2 in A only, 0 in B only" in words
    assert "1 frames TRACKING in A and LOST in B" in words


def test_a_suite_says_which_cases_missed_and_each_ones_misses_first(
    written: dict[str, Path],
) -> None:
    words = " ".join(Page(written["suite"].read_text(encoding="utf-8")).words.split())
    assert "✗ 2 of 2 cases missed: far" in words and "– skipped" in words
    rows = words[words.index("measured allowed") :]
    assert rows.index("position_max_m") < rows.index("captured = gated")


def test_a_suite_of_nothing_is_no_success(tmp_path: Path) -> None:
    cases = [Judged("later", "t", "image", skipped="no root")]
    page.write_suite(tmp_path / "s.html", "Replay tests", cases, began="")
    assert "✗ No case was flown" in (tmp_path / "s.html").read_text()


@pytest.mark.parametrize("width_px", [360, 1100])
def test_no_page_is_wider_than_the_screen(
    written: dict[str, Path], browser: Any, width_px: int
) -> None:
    tab = browser.new_page(viewport={"width": width_px, "height": 800})
    problems: list[str] = []
    tab.on("console", lambda message: problems.append(message.text))
    for path in written.values():
        tab.goto(path.as_uri())
        assert tab.evaluate("document.documentElement.scrollWidth") <= width_px
        assert tab.evaluate("[...document.images].every(i => i.complete && i.naturalWidth > 0)")
    tab.close()
    assert problems == []


def test_a_path_is_coloured_by_how_far_it_is_off_and_the_worst_lies_on_top() -> None:
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    figure = pictures.path(points, np.array([0.0, 0.5, 0.1, np.nan]))
    (drawn,) = figure.axes[0].collections
    assert np.asarray(drawn.get_array()).tolist() == [0.0, 10.0, 50.0]  # cm, NaN left out
    assert drawn.get_clim() == (0.0, 50.0)
    same = pictures.path(points, np.zeros(4))
    assert same.axes[0].collections[0].get_clim() == (0.0, 0.1)  # no rounding is painted as far


def test_states_are_drawn_where_they_were_and_pauses_left_out() -> None:
    t = np.array([0.0, 0.1, 0.2, 0.3, 5.0, 5.1])
    strip = pictures.Strip("A", t, ["LOST", "LOST", "TRACKING", "TRACKING", "TRACKING", "LOST"])
    figure = pictures.over_time(
        [("error, cm", [pictures.Series("A", t, t)], 3.0)], [strip], [(1, 2)]
    )
    bars = [(round(p.get_x(), 2), round(p.get_width(), 2)) for p in figure.axes[1].patches]  # type: ignore[attr-defined]
    assert bars[:4] == [(0.0, 0.2), (0.2, 0.2), (5.0, 0.1), (5.1, 0.1)]
    assert figure.axes[0].get_ylim()[1] > 5
    line = np.asarray(figure.axes[0].lines[0].get_ydata())
    assert np.isnan(line).sum() == 1


def test_pictures_of_nothing_are_drawn_all_the_same() -> None:
    none, empty = np.empty(0), Trajectory.from_poses([], [])
    for theme in (LIGHT, DARK):
        for figure in (
            pictures.path(np.empty((0, 3)), none, under=[("A", empty)], theme=theme),
            pictures.over_time([("error, cm", [pictures.Series("A", none, none)], None)],
                               [pictures.Strip("A", none, [])], theme=theme),
            pictures.distributions([("ms", [("A", none), ("B", np.array([np.nan]))])], theme),
        ):  # fmt: skip
            assert isinstance(figure.canvas, FigureCanvasAgg)
            figure.canvas.draw()
