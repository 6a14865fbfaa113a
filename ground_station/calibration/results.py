"""What a calibration leaves behind: the camera's file, figures for programs, text for a console."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ground_station.calibration.board import Board
from ground_station.calibration.calibrate import Result
from ground_station.files import write_text
from ground_station.presentation.text import columns


def write_camera(path: str | Path, result: Result, board: Board) -> None:
    """Writes the camera's file, as `load_camera` reads it, deviations as comments."""
    used, _ = result.corners
    camera = result.camera
    lines = [
        f"# From {len(result.views)} views of a ChArUco board of {board.name}:",
        f"# {used} corners, {result.fit.rms_px:.3f} px RMS. Behind each number its deviation.",
        f'model = "{camera.model}"'.ljust(27)
        + f"# {' '.join(result.fit.names[4:])}, pixel centres at integers",
        f"width_px = {camera.width_px}",
        f"height_px = {camera.height_px}",
    ]
    for name, value in zip(result.fit.names, result.fit.theta, strict=True):
        lines.append(
            f"{name} = {_number(name, float(value))}".ljust(27)
            + f"# ± {_deviation(name, result.fit.deviations[name])}"
        )
    lines.append(f"readout_s = {camera.readout_s:.6f}".ljust(27) + f"# {readout_words(result)}")
    write_text(path, "\n".join(lines) + "\n")


def readout_words(result: Result) -> str:
    """What is known of the rolling shutter, in a few words."""
    readout = result.readout
    if readout is None:
        return "not measured: no frames in a row with the board in motion, or no times of them"
    if not readout.determined:
        return f"not measured: the motion leaves it open (± {1e3 * readout.sigma_s:.1f} ms)"
    if readout.backwards:
        return f"not written: measured {1e3 * readout.readout_s:.2f} ms, rows from last to first"
    return f"± {readout.sigma_s:.2g} s, first row to last, {readout.windows} stretches of motion"


def document(result: Result, board: Board, inputs: Sequence[str], frames: int) -> dict[str, Any]:
    """The calibration as JSON."""
    used, wrong = result.corners
    readout = result.readout
    return {
        "inputs": [Path(name).name for name in inputs],
        "board": asdict(board),
        "frames": {
            "looked_at": frames,
            "with_board": len(result.seen),
            "used": len(result.views),
        },
        "corners": {"used": used, "left_out": wrong},
        "camera": result.camera.as_dict(),
        "sigma": result.fit.deviations,
        "rms_px": result.fit.rms_px,
        "regions": [asdict(region) for region in result.regions()],
        "readout": None
        if readout is None
        else asdict(readout) | {"determined": readout.determined},
        "views": [
            {
                "input": Path(inputs[view.seen.source]).name,
                "frame": view.seen.index,
                "name": view.seen.name,
                "corners": len(view.seen.ids),
                "rms_px": rms,
                "edge_px": view.seen.edge_px,
                "speed_px_s": view.speed_px_s,
                "tilt_deg": tilt,
                "distance_m": distance,
            }
            for view, rms, tilt, distance in result.rows()
        ],
        "notes": result.notes,
    }


def numbers(result: Result) -> list[tuple[str, str, str]]:
    """Name, value and deviation of each number of the camera, readout included when known."""
    rows = [
        (name, _number(name, float(value)), "± " + _deviation(name, result.fit.deviations[name]))
        for name, value in zip(result.fit.names, result.fit.theta, strict=True)
    ]
    readout = result.readout
    if readout is not None and result.readout_known:
        rows.append(("readout_s", f"{result.camera.readout_s:.6f}", f"± {readout.sigma_s:.6f}"))
    return rows


def region_rows(result: Result) -> list[tuple[str, str, str, str]]:
    """Each region's name, corners, RMS and how well the lens is known at its edge, as text."""
    return [
        (
            r.name,
            str(r.corners),
            f"{r.rms_px:.3f} px" if r.corners else "none used",
            "" if r.lens_px is None else f"± {r.lens_px:.2f} px",
        )
        for r in result.regions()
    ]


def table(result: Result, frames: int) -> str:
    """The calibration for a console."""
    used, wrong = result.corners
    lines = [
        f"{frames} frames, {len(result.seen)} with the board, {len(result.views)} views used: "
        f"tilted up to {result.tilts_deg.max():.0f}°, {result.distances_m.min():.2f} to "
        f"{result.distances_m.max():.2f} m away",
        f"{used} corners ({wrong} left out as wrong), {result.fit.rms_px:.3f} px RMS; worst view "
        f"{max(result.fit.view_rms_px()):.3f} px",
        "",
        *columns([["number", "value", "deviation"], *map(list, numbers(result))]),
    ]
    if not result.readout_known:
        lines.append(f"readout_s   {readout_words(result)}")
    lines += [
        "",
        *columns([["picture", "corners", "RMS", "lens"], *map(list, region_rows(result))]),
    ]
    return "\n".join(lines)


def _number(name: str, value: float) -> str:
    return f"{value:.3f}" if name.endswith("_px") else f"{value:.6f}"


def _deviation(name: str, value: float) -> str:
    return f"{value:.2g}" + (" px" if name.endswith("_px") else "")
