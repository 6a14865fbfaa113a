"""The learning curve: one JSON object a line while training runs, and a plot of them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ground_station import files
from ground_station.training.errors import TrainingError
from pi_firmware.wire.errors import os_errors_as


class Log:
    """Lines are written at once and never changed; a resumed run forgets those after its start."""

    def __init__(self, path: Path, step: int) -> None:
        self.path = path
        kept = [line for line in read(path) if line.get("step", 0) <= step]
        files.write_text(path, "".join(json.dumps(line) + "\n" for line in kept))

    def add(self, kind: str, **values: Any) -> None:
        """Appends a line."""
        with os_errors_as(self.path, TrainingError), self.path.open("a") as file:
            file.write(json.dumps({"kind": kind, **values}) + "\n")


def read(path: Path) -> list[dict[str, Any]]:
    """The lines of a log; a cut last line is left out, a log that is not there is empty."""
    try:
        text = path.read_text()
    except FileNotFoundError:
        return []
    except (OSError, ValueError) as error:
        raise TrainingError(f"{path}: {error}") from None
    lines = []
    for line in text.splitlines():
        try:
            value = json.loads(line)
        except ValueError:
            continue  # the program was killed while it wrote this one
        if isinstance(value, dict):
            lines.append(value)
    return lines


def plot(log: Path, out: Path) -> None:
    """Losses and held-out figures over the steps, those of other extractors dashed, as PNG."""
    from ground_station.presentation.theme import LIGHT, sheet, write_png

    lines = read(log)
    trained = [line for line in lines if line["kind"] == "train"]
    tried = [line for line in lines if line["kind"] == "validation"]
    others = [line for line in lines if line["kind"] == "baseline"]
    figure = sheet((16, 3.6), LIGHT)
    axes = figure.subplots(1, 4)
    for name in ("blobs", "anywhere", "worth"):
        axes[0].plot([t["step"] for t in trained], [t[name] for t in trained], lw=0.8, label=name)
    axes[0].set(title="loss", yscale="log")
    titles = {
        "accuracy": "share of matches within 3 px",
        "repeatability": "repeatability at 3 px",
        "error_px": "median distance of repeated points, px",
    }
    for axis, (name, title) in zip(axes[1:], titles.items(), strict=True):
        axis.plot([t["step"] for t in tried], [t[name] for t in tried], "k.-", label="this network")
        for k, other in enumerate(others):
            axis.axhline(other[name], ls="--", lw=0.9, color=f"C{k}", label=other["name"])
        axis.set(title=title)
    for axis in axes:
        axis.set_xlabel("step")
        axis.grid(alpha=0.3)
        axis.legend(fontsize=7)
    write_png(figure, out, 100)
