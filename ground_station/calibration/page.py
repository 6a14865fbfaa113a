"""The calibration's page: one HTML file, nothing fetched."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ground_station.calibration import pictures, results
from ground_station.calibration.board import Board
from ground_station.calibration.calibrate import Result
from ground_station.presentation.pages import shown, write_page

_TEMPLATE = Path(__file__).parent / "calibration.html"


def write_report(
    path: str | Path, result: Result, board: Board, inputs: Sequence[str], frames: int
) -> None:
    """Writes the page, beside and renamed; raises `GroundStationError` when it cannot."""
    used, wrong = result.corners
    times = pictures.magnification(result)
    views = [
        (
            f"{Path(inputs[view.seen.source]).name}, {view.seen.name}",
            str(len(view.seen.ids)),
            f"{rms:.3f}",
            f"{view.seen.edge_px:.1f}",
            f"{view.speed_px_s:.0f}" if view.velocity_px_s is not None else "—",
            f"{tilt:.0f}",
            f"{distance:.2f}",
        )
        for view, rms, tilt, distance in sorted(
            zip(
                result.views,
                result.fit.view_rms_px(),
                result.tilts_deg,
                result.distances_m,
                strict=True,
            ),
            key=lambda row: (row[0].seen.source, row[0].seen.index),
        )
    ]
    write_page(
        path,
        _TEMPLATE,
        title="Camera calibration",
        summary=(
            f"{len(result.views)} views of {len(result.seen)} with the board, in {frames} frames: "
            f"{used} corners, {wrong} left out as wrong."
        ),
        rms=f"{result.fit.rms_px:.3f} px RMS",
        size=f"{result.size_px[0]}x{result.size_px[1]} px",
        board=f"{board.name}, {board.square_mm:g} mm",
        numbers=results.numbers(result),
        readout=results.readout_words(result),
        regions=results.region_rows(result),
        notes=result.notes,
        figures=[
            shown(
                "Where corners were seen",
                "The corners of the board in the picture; the four corners of the picture framed",
                lambda theme: pictures.coverage(result, theme),
            ),
            shown(
                f"Residuals, {times:g} times as long",
                "Arrows from where the lens puts each corner to where it was seen",
                lambda theme: pictures.residuals(result, theme),
            ),
            shown(
                "Each view",
                "The RMS of each view's residuals, and the median",
                lambda theme: pictures.per_view(result, theme),
            ),
        ],
        views=views,
    )
