"""What a long run leaves behind: one JSON document and one picture, also when it is cut short."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ground_station.errors import GroundStationError
from ground_station.files import write_json
from soaking.judging import rows as slope_rows
from soaking.measures import Measure, from_document
from soaking.table import Row, show


def write(
    out: Path,
    measures: Sequence[Measure],
    settled_s: float,
    more: Mapping[str, Any],
    rows: Sequence[Row] = (),
) -> None:
    """Writes the figures; without rows as a run that has not ended yet."""
    out.parent.mkdir(parents=True, exist_ok=True)
    document = {
        **more,
        "rows": [asdict(row) for row in rows],
        "settled_s": settled_s,
        "measures": [measure.document() for measure in measures],
    }
    write_json(out, document)


def conclude(
    rows: Sequence[Row],
    measures: Sequence[Measure],
    settled_s: float,
    about: Mapping[str, Any],
    out: Path | None,
) -> int:
    """Prints the table, writes and draws what was measured; 1 when a bound is missed, else 0."""
    show(rows)
    if out is not None:
        write(out, measures, settled_s, about, rows)
        if measures:
            print(draw(out, measures, settled_s, about["title"]))
    return 0 if all(row.holds for row in rows) else 1


def draw(out: Path, measures: Sequence[Measure], settled_s: float, title: str) -> Path:
    """Draws the picture beside a document; returns its path."""
    from ground_station.presentation.theme import write_png
    from soaking.drawing import picture

    path = out.with_suffix(".png")
    write_png(picture(measures, settled_s, title), path)
    return path


def again(out: Path) -> tuple[list[Row], Path]:
    """The slopes of an earlier run's document judged again, and its picture drawn again.

    Raises `GroundStationError` with one line.
    """
    try:
        document = json.loads(out.read_text())
        measures = [from_document(one) for one in document["measures"]]
        settled_s, title = float(document["settled_s"]), str(document["title"])
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise GroundStationError(f"{out}: no document of a long run: {error}") from None
    return slope_rows(measures, settled_s), draw(out, measures, settled_s, title)
