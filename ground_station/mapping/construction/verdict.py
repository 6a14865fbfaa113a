"""What a build says at its end: whether the map is whole, how exact it is, and what to do next."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ground_station.map.store import Map

_MOST_LINES = 4
_MOST_RUNS = 3
"""Stretches of names a line, lines of a kind: the rest stands in map.toml."""


@dataclass(frozen=True)
class Verdict:
    """`word` is whole, incomplete, in parts or doubtful; `lines` are for a person, it first."""

    word: str
    lines: list[str]
    missing: list[str]
    """Names of the images that have no place in this map."""


def verdict(map_: Map) -> Verdict:
    """Judges a map by what its build has written into `info.built`; what it lacks is not said.

    Of `built` are read: `images`, `registered`, `model_sizes`, `reprojection_px`, `observations`,
    and where they are there `left_out` (a reason for each image's name), `parts` (the names of
    each model's images, the largest first), `doubts` (sentences), `noise_px` and `lens` (`said`, a
    sentence).
    """
    built, names = map_.info.built, map_.keyframes.names
    images, registered = int(built.get("images", len(names))), len(names)
    parts = [list(part) for part in built.get("parts", [])][1:]
    doubts = [str(doubt) for doubt in built.get("doubts", [])]
    reasons: dict[str, str] = built.get("left_out", {})
    apart = {name for part in parts for name in part} - set(names)
    word, first = _first(images, registered, _other_sizes(built), doubts)
    every = sorted({*names, *reasons, *apart})
    lines = [first]
    lines += _few([f"doubt: {doubt}" for doubt in doubts], "doubts")
    if parts:
        shown = [f"part 1, this map: {_runs(names, every)}"]
        shown += [f"part {k}, apart: {_runs(part, every)}" for k, part in enumerate(parts, 2)]
        lines += _few(shown, "parts")
    alone = {name: why for name, why in reasons.items() if name not in apart}
    lines += _few(_left_out_lines(alone, every), "reasons")
    lines.append(_exact(map_))
    if "lens" in built:
        lines.append(f"lens: {built['lens']['said']}")
    lines.append(_scale(map_))
    return Verdict(word, lines, [name for name in every if name not in set(names)])


def first_line(built: Mapping[str, Any]) -> str:
    """The first of the lines, by what the build wrote alone: no map needs to be read for it."""
    registered = int(built.get("registered", 0))
    images = int(built.get("images", registered))
    return _first(images, registered, _other_sizes(built), built.get("doubts", []))[1]


def next_step(found: Verdict, map_: Map, folder: str | Path) -> str:
    """The command to give next, and why, as `cli.next_of` has it."""
    where = shlex.quote(str(folder))
    if found.word in ("doubtful", "in parts"):
        page = shlex.quote(f"{Path(folder).name}.html")
        why = "look at it before it is trusted"
        if found.word == "in parts":
            why = "see what is there; film what joins the parts, and build with both"
            if map_.info.features == "rootsift":  # measured: `features/README.md`
                why += "; or build with --features lark, which may join them: read its doubts"
        return f"blimp map view {where} --out {page} --open    ({why})"
    if map_.info.registered:
        return f"blimp localize VIDEO --map {where} --out est.txt"
    plan = "" if (Path(folder) / "floorplan.yaml").exists() else " --plan floorplan.png"
    return f"blimp map register {where} --page{plan}    (its scale and its place in the building)"


def _first(
    images: int, registered: int, sizes: Sequence[int], doubts: Sequence[str]
) -> tuple[str, str]:
    held = f"{registered} of {images} images"
    if doubts:
        count = "one thing" if len(doubts) == 1 else f"{len(doubts)} things"
        return "doubtful", (
            f"DOUBTFUL: {held} stand in this map, and {count} could not be decided: "
            "places in it may be wrong"
        )
    if sizes:
        other = "another part" if len(sizes) == 1 else f"{len(sizes)} other parts"
        counts = " and ".join(map(str, sizes)) if len(sizes) < 4 else f"{sum(sizes)} in all"
        return "in parts", (
            f"IN PARTS: {held} stand in this map; {other} of {counts} images could not be joined "
            "to it"
        )
    if registered < images:
        return "incomplete", (
            f"INCOMPLETE: {held} stand in this map, in one piece; {images - registered} are left "
            "out"
        )
    return "whole", f"WHOLE: all {images} images stand in this map, in one piece"


def _other_sizes(built: Mapping[str, Any]) -> list[int]:
    """How many images each of the other parts has."""
    sizes = [len(part) for part in built.get("parts", [])][1:]
    return sizes or [int(n) for n in built.get("model_sizes", [])][1:]


def _left_out_lines(reasons: Mapping[str, str], every: Sequence[str]) -> list[str]:
    """One line a reason, those of most images first."""
    by_reason: dict[str, list[str]] = {}
    for name, why in reasons.items():
        by_reason.setdefault(why, []).append(name)
    ordered = sorted(by_reason.items(), key=lambda item: -len(item[1]))
    return [f"left out: {_runs(names, every)}: {why}" for why, names in ordered]


def _runs(names: Sequence[str], every: Sequence[str]) -> str:
    """Names as stretches of those that follow each other among all."""
    rank = {name: k for k, name in enumerate(every)}
    runs: list[list[str]] = []
    for name in sorted(names):
        if runs and rank[name] == rank[runs[-1][-1]] + 1:
            runs[-1].append(name)
        else:
            runs.append([name])
    shown = [
        run[0] if len(run) == 1 else f"{run[0]} to {run[-1]} ({len(run)})"
        for run in runs[:_MOST_RUNS]
    ]
    rest = sum(len(run) for run in runs[_MOST_RUNS:])
    return ", ".join(shown) + (f" and {rest} more" if rest else "")


def _few(lines: list[str], what: str) -> list[str]:
    """The first lines of a kind, and how many more there are."""
    if len(lines) <= _MOST_LINES:
        return lines
    rest = len(lines) - _MOST_LINES + 1
    return [*lines[: _MOST_LINES - 1], f"… {rest} more {what}: blimp map info has all"]


def _exact(map_: Map) -> str:
    built = map_.info.built
    text = f"exact: {len(map_.landmarks)} landmarks"
    if "reprojection_px" in built:
        count = built.get("observations", "their")
        text += f" fit {count} observations to {built['reprojection_px']:.2f} px"
    if "noise_px" in built:
        text += f"; a key point's noise is {built['noise_px']:.2f} px"
    return text


def _scale(map_: Map) -> str:
    if map_.info.registered:
        return "scale: metres, in the world's frame"
    if map_.info.units == "m":
        return "scale: metres, in no world yet"
    return "scale: unknown until the map is registered; lengths in it are its own"
