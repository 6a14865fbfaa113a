"""A replay's report: the page, and the same figures for a console."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cases_stand as stand
import numpy as np
import pytest
from parsed_page import Page

from ground_station.errors import GroundStationError
from ground_station.evaluation.figures import AT_LEAST, Row
from ground_station.map.floorplan import FloorPlan
from ground_station.replay.flight_report import (
    POSITION,
    ROTATION,
    FlightReport,
    draw_matches,
    summary_table,
    write_report,
)


def full() -> FlightReport:
    picture = draw_matches(
        np.full((48, 64), 90, np.uint8), np.array([[10.0, 10]]), np.array([[12.0, 11]])
    )
    row = {"position_m": 0.0351, "rotation_deg": 0.296, "position_zhang_m": 0.0776}
    plan = FloorPlan(np.full((40, 40), 255, np.uint8), 0.1, (0.0, 0.0, 0.0))
    return FlightReport(
        title="Atrium & <sample>",
        document={
            "frames": {"captured": 1500, "gated": 15, "discarded": 0, "sent": 1485,
                       "received": 1480, "lost": 5, "dropped": 3, "localized": 1470},
            "ate": {"none": row, "se3": row, "sim3": None},
            "stage_ms": {"features": 90.04, "pose graph": 22},
            "stage_p99_ms": {"features": 120.0, "pose graph": 31},
            "latency_ms": {"p50": 181.0, "p99": 240.5},
            "rate_hz": 5.0,
        },
        outcome=dataclasses.replace(stand.outcome(), floorplan=plan),
        simulated=True,
        bounds=[
            Row.bounded(POSITION, 0.035, "m", 0.1),
            Row.bounded("localized", 99, "%", 95, AT_LEAST),
        ],
        pictures=[(picture, "frame 5: <1> match")],
        settings={"localizer": {"preset": "thesis", "solver": {"sigma_px": 5.0}}, "rate_hz": 5},
        seeds={"simulator": 42},
        notes=["flight.mcap: cut; 1500 frames read"],
    )  # fmt: skip


def bare() -> FlightReport:
    """Of a flight of which nothing came, without a truth or a bound."""
    frames = dict.fromkeys(full().document["frames"], 0)
    nothing = {"frames": frames, "ate": None, "stage_ms": {}, "stage_p99_ms": {}, "latency_ms": {}}
    return FlightReport("Bare", nothing | {"rate_hz": 0.0}, stand.outcome([]), simulated=False)


def written(path: Path, report: FlightReport) -> Page:
    write_report(path, report)
    return Page(path.read_text(encoding="utf-8"))


def test_the_page_stands_alone_and_tells_a_pilot_everything(tmp_path: Path) -> None:
    page = written(tmp_path / "r.html", full())
    page.assert_alone()
    assert page.pictures() == (3, 2)  # two plots in two dresses, one frame
    assert [p.name for p in tmp_path.glob("*.part")] == []
    words = " ".join(page.words.split())
    for text in (
        "Atrium & <sample>", "Simulated flight", "from the flight simulator",
        "1470 of 1500 captured frames localized.", "✓ All 2 bounds met",
        "captured 1 500 100.0%", "gated 15 1.0%", "lost 5 0.3%", "localized 1 470 98.0%",
        "dropped 3", "unaligned 0.0351 m 0.296° 0.0776 m", "Sim(3) — — —",
        "features 90.0 120.0", "capture to pose 181.0 240.5", "Time at 5 Hz",
        "Path", "Over time",
        "frame 5: <1> match", "cut; 1500 frames read", "seed: simulator 42",
        "localizer.solver.sigma_px 5.0",
    ):  # fmt: skip
        assert text in words, text


def test_a_missed_bound_is_said_first_and_by_name_and_a_real_flight_is_not_called_simulated(
    tmp_path: Path,
) -> None:
    missed = [Row.bounded(ROTATION, float("nan"), "°", 0.6)]
    missed += [Row.bounded("latency", None, "ms", 100)]
    report = dataclasses.replace(
        full(),
        bounds=[*full().bounds, *missed],
        simulated=False,
        outcome=stand.outcome([]),  # nothing to draw, which takes its time
    )
    assert not report.passed
    words = " ".join(written(tmp_path / "r.html", report).words.split())
    said = f"✗ 2 of 4 bounds missed: {ROTATION}, latency"
    assert said in words and words.index(said) < words.index("Frames")
    assert "not measured" in words
    assert "MISSED" in summary_table(report)
    assert "Recorded flight" in words and "imulat" not in words.replace("seed: simulator", "")


def test_what_is_left_out_is_left_out(tmp_path: Path) -> None:
    page = written(tmp_path / "r.html", bare())
    assert "0 of 0 captured frames localized." in page.words
    assert not [tag for tag, _ in page.tags if tag == "img"]
    for title in ("Bounds", "Error against", "Frames with their matches", "Notes"):
        assert title not in page.words
    text = summary_table(bare())
    assert text.startswith("Bare\n") and text.endswith("0 of 0 captured frames localized.")
    assert "error (RMSE)" not in text and "bounds" not in text


def test_the_console_table_has_aligned_columns() -> None:
    text = summary_table(full())
    frames = text[text.index("frames\n") : text.index("error")].splitlines()[1:-1]
    assert len(frames) == 8 and len({len(line) for line in frames}) == 1
    for words in (
        "captured    1 500   100.0%",
        "0.0351 m",
        "capture to pose",
        "(simulated flight)",
    ):
        assert words in text
    assert all(line == line.rstrip() for line in text.splitlines())


def test_a_page_that_cannot_be_written_is_told_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(GroundStationError, match=r"^[^\n]*r\.html: No such file or directory$"):
        write_report(tmp_path / "no" / "r.html", bare())


def test_matches_are_drawn_where_they_are_in_the_colour_of_their_residual() -> None:
    image = np.full((40, 60), 100, np.uint8)
    pixels = np.array([[10.0, 10.0], [30.0, 20.0], [50.0, 30.0], [5.0, 5.0], [5.0, 5.0]])
    projected = np.array([[10.0, 10.0], [33.0, 20.0], [50.0, 20.0], [np.nan, 3.0], [1e9, 5.0]])
    drawn = draw_matches(image, pixels, projected)
    assert drawn.shape == (80, 120, 3) and (image == 100).all()
    blue, yellow, red = (drawn[y, x].astype(int) for y, x in ((20, 14), (40, 54), (60, 94)))
    assert blue[2] > blue[0] + 50  # rings: 6 px left of (2u + 0.5, 2v + 0.5)
    assert yellow[0] > yellow[2] + 50 and yellow[1] > 120
    assert red[0] > red[1] + 50
    assert (drawn[6:14, 0:8] == 75).all()  # what is not finite or far outside is not drawn
    empty = draw_matches(image, np.empty((0, 2)), np.empty((0, 2)))
    assert (empty == 75).all()
