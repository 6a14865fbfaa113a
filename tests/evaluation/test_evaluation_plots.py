"""The plot of an evaluation, and the floor plan that paths are drawn over."""

from __future__ import annotations

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

from ground_station.errors import GroundStationError, InputError
from ground_station.evaluation import ate, plots
from ground_station.geometry.trajectory import Trajectory
from ground_station.map.floorplan import FloorPlan, load_floorplan
from ground_station.presentation.theme import LIGHT, figure_of, write_png


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


def drawn(plan: FloorPlan) -> Figure:
    figure, (axes,) = figure_of((8.0, 5.6), LIGHT)
    plots.show_floorplan(axes, plan, LIGHT)
    axes.set_aspect("equal")
    return figure


def brightness_at(figure: Figure, x: float, y: float) -> int:
    """Of the rendered figure at a place in its first axes."""
    canvas = figure.canvas
    assert isinstance(canvas, FigureCanvasAgg)
    canvas.draw()
    u, v = figure.axes[0].transData.transform((x, y))
    buffer = np.asarray(canvas.buffer_rgba())
    return int(buffer[buffer.shape[0] - 1 - round(v), round(u), :3].mean())


def test_the_floor_plan_lies_where_its_origin_says(tmp_path: Path, floorplan: Path) -> None:
    figure = drawn(load_floorplan(floorplan))
    assert brightness_at(figure, 1.03, 7.03) < 180  # the top of the picture is far in y
    assert brightness_at(figure, 1.03, 1.03) > 240 and brightness_at(figure, 8.53, 7.03) > 240
    image = np.full((80, 100), 255, np.uint8)
    image[:20, :20] = 0
    turned = load_floorplan(write_plan(tmp_path, image, [20.0, -3.0, np.pi / 2]))
    figure = drawn(turned)
    # A quarter turn about its lower left corner takes (1, 7) to (-7, 1).
    assert brightness_at(figure, 20 - 7.03, -3 + 1.03) < 180
    assert brightness_at(figure, 20 - 1.03, -3 + 1.03) > 240


def test_lines_break_where_nothing_was_estimated() -> None:
    whole = circle()
    part = whole[np.r_[0:40, 60:100]]
    figure = plots.evaluation(ate.evaluate(part, whole))
    for axes in figure.axes:
        x = np.asarray(axes.lines[-1].get_xdata())
        assert np.isnan(x).sum() == 1 and np.isnan(x[40])


def test_a_plot_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    path, figure = tmp_path / "p.png", plots.evaluation(ate.evaluate(circle(), circle()))
    write_png(figure, path)
    assert cv2.imread(str(path)) is not None and not list(tmp_path.glob("*.part"))
    with pytest.raises(GroundStationError, match=r"p\.png"):
        write_png(figure, tmp_path / "no" / "p.png")


def test_plots_keep_no_global_state() -> None:
    code = (
        "import sys; from ground_station.replay import flight_report;"
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
