"""The report page, its plots, and the same figures for a console."""

from __future__ import annotations

import base64
import re
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from parsed_page import Page

from ground_station.errors import GroundStationError, InputError
from ground_station.evaluation import plots
from ground_station.evaluation.figures import AT_LEAST, Row
from ground_station.evaluation.report import (
    MatchPicture,
    ReportData,
    draw_matches,
    summary_table,
    write_report,
)
from ground_station.geometry.trajectory import Trajectory
from ground_station.map.floorplan import load_floorplan
from ground_station.presentation.theme import write_png


def circle(n: int = 100) -> Trajectory:
    angle = np.linspace(0, 2 * np.pi, n)
    position = np.column_stack([5 + 3 * np.cos(angle), 4 + 2 * np.sin(angle), np.ones(n)])
    return Trajectory(np.arange(n) * 200_000_000, position, np.tile([0.0, 0.0, 0.0, 1.0], (n, 1)))


@pytest.fixture
def floorplan(tmp_path: Path) -> Path:
    """10 m by 8 m, 0.1 m a pixel, a dark block in the picture's top left corner."""
    image = np.full((80, 100), 255, np.uint8)
    image[:20, :20] = 0
    return write_plan(tmp_path, image, [0.0, 0.0, 0.0])


def write_plan(folder: Path, image: np.ndarray, origin: list[float]) -> Path:
    cv2.imwrite(str(folder / "floorplan.png"), image)
    path = folder / "floorplan.yaml"
    path.write_text(
        yaml.safe_dump({"image": "floorplan.png", "resolution": 0.1, "origin": origin, "negate": 0})
    )
    return path


def full_data(floorplan: Path) -> ReportData:
    truth = circle()
    n = len(truth)
    picture = draw_matches(np.full((48, 64), 90, np.uint8), [[10, 10]], [[12, 11]], [2.2])
    row = {"position_m": 0.0351, "rotation_deg": 0.296, "position_zhang_m": 0.0776}
    return ReportData(
        title="Atrium & <sample>",
        verdict=["Localized live at 5 Hz.", "Second line."],
        simulated=True,
        bounds=[
            Row.bounded("position error", 0.035, "m", 0.1),
            Row.bounded("localized", 99, "%", 95, AT_LEAST),
        ],
        frames={"captured": 1500, "gated": 15, "sent": 1485, "received": 1480, "lost": 5,
                "localized": 1470, "late": 3},
        ate={"none": row, "se3": row, "sim3": None},
        stage_ms={"features": {"p50": 90.04, "p99": 120.0}, "pose graph": {"p50": 22, "p99": 31}},
        latency_ms={"p50": 181.0, "p99": 240.5},
        rate_hz=5.0,
        truth=truth,
        estimate=truth,
        error_time_s=truth.time_ns / 1e9,
        error_position_m=np.where(np.arange(n) == 7, np.nan, 0.03),
        error_rotation_deg=np.full(n, 0.3),
        latency_time_s=truth.time_ns / 1e9,
        latency_each_ms=np.full(n, 180.0),
        position_limit_m=0.1,
        rotation_limit_deg=0.6,
        floorplan=floorplan,
        pictures=[MatchPicture(picture, "frame 5: <1> match")],
        settings={"localizer": {"preset": "thesis", "solver": {"sigma_px": 5.0}}, "rate_hz": 5},
        seeds={"simulator": 42},
        notes=["flight.mcap: cut; 1500 frames read"],
    )  # fmt: skip


def written(path: Path, data: ReportData) -> Page:
    write_report(path, data)
    return Page(path.read_text(encoding="utf-8"))


def test_the_page_fetches_nothing_and_runs_nothing(tmp_path: Path, floorplan: Path) -> None:
    page = written(tmp_path / "r.html", full_data(floorplan))
    names = {tag for tag, _ in page.tags}
    assert not names & {"script", "link", "iframe", "object", "embed", "form"}
    sources = [
        value
        for _, attributes in page.tags
        for key, value in attributes.items()
        if key in ("src", "srcset", "href")
    ]
    assert sources and all(re.match(r"data:image/(png|jpeg);base64,", str(s)) for s in sources)
    assert not re.search(r"https?://|url\(", (tmp_path / "r.html").read_text(encoding="utf-8"))
    assert not [key for _, attributes in page.tags for key in attributes if key.startswith("on")]
    assert [p.name for p in tmp_path.glob("*.part")] == []


def test_the_pictures_in_the_page_can_be_decoded(tmp_path: Path, floorplan: Path) -> None:
    page = written(tmp_path / "r.html", full_data(floorplan))
    images = [a["src"] for tag, a in page.tags if tag == "img"]
    darks = [a["srcset"] for tag, a in page.tags if tag == "source"]
    assert len(images) == 4 and len(darks) == 3  # three plots in two dresses, one frame
    for uri in images + darks:
        raw = base64.b64decode(str(uri).split(",")[1])
        assert cv2.imdecode(np.frombuffer(raw, np.uint8), cv2.IMREAD_COLOR) is not None
    assert all(a.get("alt") for tag, a in page.tags if tag == "img")


def test_the_page_tells_a_pilot_everything(tmp_path: Path, floorplan: Path) -> None:
    words = " ".join(written(tmp_path / "r.html", full_data(floorplan)).words.split())
    for text in (
        "Atrium & <sample>", "Simulated flight", "from the flight simulator",
        "Localized live at 5 Hz.", "✓ All 2 bounds met",
        "captured 1 500 100.0%", "gated 15 1.0%", "lost 5 0.3%", "localized 1 470 98.0%",
        "late 3", "unaligned 0.0351 m 0.296° 0.0776 m", "Sim(3) — — —",
        "features 90.0 120.0", "capture to pose 181.0 240.5", "Time at 5 Hz",
        "Path over the floor plan", "Error over time", "Latency over time",
        "frame 5: <1> match", "cut; 1500 frames read", "seed: simulator 42",
        "localizer.solver.sigma_px 5.0",
    ):  # fmt: skip
        assert text in words, text


def test_a_missed_bound_is_said_first_and_by_name(tmp_path: Path, floorplan: Path) -> None:
    data = full_data(floorplan)
    data.bounds = [*data.bounds, Row.bounded("rotation error", float("nan"), "°", 0.6)]
    data.bounds += [Row.bounded("latency", None, "ms", 100)]
    assert not data.passed
    words = " ".join(written(tmp_path / "r.html", data).words.split())
    said = "✗ 2 of 4 bounds missed: rotation error, latency"
    assert said in words and words.index(said) < words.index("Frames")
    assert "not measured" in words
    assert "MISSED" in summary_table(data)


def test_a_real_flight_is_not_called_simulated(tmp_path: Path, floorplan: Path) -> None:
    data = full_data(floorplan)
    data.simulated = False
    words = written(tmp_path / "r.html", data).words
    assert "Recorded flight" in words and "imulat" not in words.replace("seed: simulator", "")


def test_what_is_left_out_is_left_out(tmp_path: Path) -> None:
    page = written(tmp_path / "r.html", ReportData("Bare", ["Nothing flew."], simulated=False))
    assert "Nothing flew." in page.words
    assert not [tag for tag, _ in page.tags if tag in ("table", "img", "h2")]
    assert summary_table(ReportData("Bare", ["Nothing flew."], simulated=False)).split() == [
        "Bare", "Nothing", "flew.",
    ]  # fmt: skip


def test_the_console_table_has_aligned_columns(floorplan: Path) -> None:
    text = summary_table(full_data(floorplan))
    frames = text[text.index("frames\n") : text.index("error")].splitlines()[1:-1]
    assert len(frames) == 7 and len({len(line) for line in frames}) == 1
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
        write_report(tmp_path / "no" / "r.html", ReportData("t", [], simulated=True))


def test_matches_are_drawn_where_they_are_in_the_colour_of_their_residual() -> None:
    image = np.full((40, 60), 100, np.uint8)
    pixels = np.array([[10.0, 10.0], [30.0, 20.0], [50.0, 30.0], [np.nan, 1.0], [5.0, 5.0]])
    projected = np.array([[10.0, 10.0], [33.0, 20.0], [50.0, 20.0], [3.0, 3.0], [1e9, 5.0]])
    drawn = draw_matches(image, pixels, projected, [0.5, 3.0, 10.0, 1.0, 9.0])
    assert drawn.shape == (80, 120, 3) and (image == 100).all()
    blue, yellow, red = (drawn[y, x].astype(int) for y, x in ((20, 14), (40, 54), (60, 94)))
    assert blue[2] > blue[0] + 50  # rings: 6 px left of (2u + 0.5, 2v + 0.5)
    assert yellow[0] > yellow[2] + 50 and yellow[1] > 120
    assert red[0] > red[1] + 50
    assert (drawn[6:14, 0:8] == 75).all()  # what is not finite or far outside is not drawn
    empty = draw_matches(image, np.empty((0, 2)), np.empty((0, 2)), [])
    assert (empty == 75).all()


def brightness_at(figure: Figure, x: float, y: float) -> int:
    """Of the rendered figure at a place in its first axes."""
    canvas = figure.canvas
    assert isinstance(canvas, FigureCanvasAgg)
    canvas.draw()
    u, v = figure.axes[0].transData.transform((x, y))
    buffer = np.asarray(canvas.buffer_rgba())
    return int(buffer[buffer.shape[0] - 1 - round(v), round(u), :3].mean())


def test_the_floor_plan_lies_where_its_origin_says(tmp_path: Path, floorplan: Path) -> None:
    figure = plots.trajectory_plot(None, None, load_floorplan(floorplan))
    assert brightness_at(figure, 1.03, 7.03) < 180  # the top of the picture is far in y
    assert brightness_at(figure, 1.03, 1.03) > 240 and brightness_at(figure, 8.53, 7.03) > 240
    image = np.full((80, 100), 255, np.uint8)
    image[:20, :20] = 0
    turned = load_floorplan(write_plan(tmp_path, image, [20.0, -3.0, np.pi / 2]))
    figure = plots.trajectory_plot(None, None, turned)
    # A quarter turn about its lower left corner takes (1, 7) to (-7, 1).
    assert brightness_at(figure, 20 - 7.03, -3 + 1.03) < 180
    assert brightness_at(figure, 20 - 1.03, -3 + 1.03) > 240


def test_lines_break_where_nothing_was_estimated() -> None:
    whole = circle()
    keep = np.r_[0:40, 60:100]
    part = whole[keep]
    figure = plots.trajectory_plot(whole, part)
    truth, estimate = (np.asarray(line.get_xdata()) for line in figure.axes[0].lines[:2])
    assert len(truth) == 100 and not np.isnan(truth).any()
    assert np.isnan(estimate).sum() == 1 and np.isnan(estimate[40])
    errors = plots.error_plot(part.time_ns / 1e9, np.ones(80), np.ones(80))
    assert all(np.isnan(np.asarray(a.lines[0].get_xdata())).sum() == 1 for a in errors.axes)


def test_bounds_and_percentiles_are_inside_the_picture() -> None:
    figure = plots.error_plot([0, 1], [0.01, 0.02], [0.1, 0.1], position_limit_m=0.1)
    assert figure.axes[0].get_ylim()[1] > 10 and figure.axes[1].get_ylim()[1] < 1
    figure = plots.latency_plot([0, 1], [20.0, 30.0], median_ms=25, p99_ms=90)
    assert figure.axes[0].get_ylim()[1] > 90
    labels = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert labels == ["median, 25 ms", "99th percentile, 90 ms"]


def test_a_plot_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "p.png"
    write_png(plots.trajectory_plot(circle(), None), path)
    assert cv2.imread(str(path)) is not None and not list(tmp_path.glob("*.part"))
    with pytest.raises(GroundStationError, match=r"p\.png"):
        write_png(plots.trajectory_plot(None, None), tmp_path / "no" / "p.png")


def test_plots_keep_no_global_state() -> None:
    code = (
        "import sys; from ground_station.evaluation import plots, report;"
        "sys.exit('matplotlib.pyplot' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], timeout=60, check=False).returncode == 0


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"resolution": 0.0}, "allowed: 0.0001 to 10"),
        ({"resolution": float("nan")}, "allowed"),
        ({"origin": [0.0, 0.0]}, "needs image, resolution and origin"),
        ({"image": "missing.png"}, "missing.png"),
        ({"image": None}, "needs image, resolution and origin"),
        ({"image": "a\0b"}, "needs image, resolution and origin"),
        ({"image": "/dev/zero"}, "must lie beside"),
        ({"resolution": 10**400}, "needs image, resolution and origin"),
        ({"note": "x" * 70_000}, "more than 65536 bytes"),
    ],
)
def test_a_wrong_floor_plan_is_refused_in_one_line(
    floorplan: Path, change: dict[str, object], says: str
) -> None:
    floorplan.write_text(yaml.safe_dump({**yaml.safe_load(floorplan.read_text()), **change}))
    with pytest.raises(InputError) as error:
        load_floorplan(floorplan)
    assert says in str(error.value) and "\n" not in str(error.value)


def test_files_that_are_no_floor_plan_are_refused(tmp_path: Path) -> None:
    (tmp_path / "list.yaml").write_text("- 1\n- 2\n")
    (tmp_path / "bad.yaml").write_text("image: [\n")
    (tmp_path / "code.yaml").write_text("image: !!python/object/apply:os.getcwd []\n")
    (tmp_path / "date.yaml").write_text("image: a.png\nresolution: 2001-13-41\n")
    (tmp_path / "deep.yaml").write_text("[" * 5000)
    laughs = "".join(f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in pairwise("abcdefghi"))
    text = f"a: &a [x, x, x, x, x, x, x, x, x]\n{laughs}image: *i\nresolution: 1\norigin: [0, 0, 0]"
    (tmp_path / "laughs.yaml").write_text(text)
    for name in ("list", "bad", "code", "missing", "date", "deep", "laughs"):
        with pytest.raises(InputError, match=rf"{name}\.yaml"):
            load_floorplan(tmp_path / f"{name}.yaml")
