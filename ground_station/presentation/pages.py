"""One HTML file a page, with all it shows inside: what every report of this product looks like.

A room's template extends `base.html` and fills its `body` and, where it needs rules of its own,
its `style`. Pictures come in two dresses, of which the reader's browser takes the one that suits.
"""

from __future__ import annotations

import base64
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import jinja2
from matplotlib.figure import Figure

from ground_station.files import write_text
from ground_station.presentation.theme import DARK, LIGHT, Theme, png
from pi_firmware.wire.text import printable

TEMPLATES = Path(__file__).parent / "templates"


@dataclass(frozen=True)
class ThemedFigure:
    """A picture in two dresses as data URIs, and words for those who do not see it."""

    heading: str
    light: str
    dark: str
    words: str


def themed_figure(heading: str, words: str, draw: Callable[[Theme], Figure]) -> ThemedFigure:
    """The picture that `draw` makes in each theme."""
    light, dark = (data_uri("png", png(draw(theme))) for theme in (LIGHT, DARK))
    return ThemedFigure(heading, light, dark, words)


def data_uri(kind: str, encoded: bytes) -> str:
    """An image file of that kind as an address that holds it."""
    return f"data:image/{kind};base64," + base64.b64encode(encoded).decode("ascii")


def write_page(path: str | Path, template: Path, **values: object) -> None:
    """Fills a template, whose `include` finds what lies beside it, and writes the page.

    Values are text and never markup. Names come from files: what cannot be printed, or turns the
    text around, is shown as `?`.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader([template.parent, TEMPLATES]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_printable,
    )
    write_text(path, environment.get_template(template.name).render(**values))


def _printable(value: object) -> object:
    return printable(value) if type(value) is str else value
