"""The theme of a picture: its colours by day and by night, and what they are put on.

Figures are plain objects (no global state). Colours are of Okabe and Ito's palette, which people of
every colour vision can tell apart.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ground_station.files import write_bytes

_DPI = 160


@dataclass(frozen=True)
class Theme:
    """The colours of a picture."""

    paper: str
    ink: str
    grid: str
    truth: str
    estimate: str
    second: str
    limit: str


LIGHT = Theme("#ffffff", "#1d2329", "#d7dce1", "#1d2329", "#0072b2", "#d55e00", "#8a5a00")
DARK = Theme("#171b20", "#e4e8ec", "#3a424b", "#f2f2f2", "#56b4e9", "#e69f00", "#f0e442")


def sheet(size_inches: tuple[float, float], theme: Theme) -> Figure:
    """An empty figure on that theme's paper."""
    figure = Figure(figsize=size_inches, layout="constrained", facecolor=theme.paper)
    FigureCanvasAgg(figure)
    return figure


def figure_of(
    size_inches: tuple[float, float],
    theme: Theme,
    rows: int = 1,
    columns: int = 1,
    *,
    label_size: float | None = None,
    **grid: Any,
) -> tuple[Figure, list[Axes]]:
    """A figure in that theme and its axes, row by row; `grid` is as `Figure.subplots` takes it."""
    figure = sheet(size_inches, theme)
    axes = list(figure.subplots(rows, columns, squeeze=False, **grid).ravel())
    for one in axes:
        themed(one, theme, label_size)
    return figure, axes


def themed(axes: Axes, theme: Theme, label_size: float | None = None) -> None:
    """Gives axes a page's colours and two spines; the numbers' size in points, where given."""
    axes.set_facecolor(theme.paper)
    axes.grid(True, color=theme.grid, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(colors=theme.ink, length=3)
    if label_size is not None:
        axes.tick_params(labelsize=label_size)
    axes.xaxis.label.set_color(theme.ink)
    axes.yaxis.label.set_color(theme.ink)
    for name, spine in axes.spines.items():
        spine.set_visible(name in ("left", "bottom"))
        spine.set_color(theme.ink)


ABOVE: dict[str, Any] = {
    "loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "ncols": 4, "frameon": False,
    "handlelength": 1.6, "borderpad": 0.0, "columnspacing": 1.2,
}  # fmt: skip
"""A legend over the axes, not in them."""


def legend(axes: Axes, theme: Theme, **where: Any) -> None:
    """A legend in that theme, where anything has a label; `where` as `Axes.legend` takes it."""
    usual = {"loc": "upper right", "fontsize": 9, "framealpha": 0.9, "facecolor": theme.paper,
             "edgecolor": theme.grid, "labelcolor": theme.ink}  # fmt: skip
    if axes.get_legend_handles_labels()[1] or "handles" in where:
        axes.legend(**usual | where)


def png(figure: Figure, dpi: int = _DPI) -> bytes:
    """The figure as PNG bytes; `dpi` are pixels to an inch."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()


def write_png(figure: Figure, path: str | Path, dpi: int = _DPI) -> None:
    """Writes the figure as a PNG file, beside and renamed."""
    write_bytes(path, png(figure, dpi))
