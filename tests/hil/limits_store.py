"""The measured trials on disk, taken up again by level and seed; and the limits as README has them.

README's table is made of an accepted run and stands between two markers.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from limits_axes import BORNE, Axis, Found, Level
from limits_stand import Flight, Measured

from ground_station.bench.machine import machine
from ground_station.errors import GroundStationError
from ground_station.files import write_json
from ground_station.presentation.readme import Block
from ground_station.presentation.text import markdown

SCHEMA = 1


class Store:
    """A document of trials in a file, which goes on from what the file has already.

    A trial counts again where level and seed are the same: a changed level's are measured anew, and
    with `undisturbed` those, too, during which others used more of the machine than that, cores.
    Raises `GroundStationError` for a file of another flight, duration, machine or kind.
    """

    def __init__(
        self,
        path: Path,
        flight: Flight,
        seeds: Sequence[int],
        undisturbed: float | None = None,
    ) -> None:
        self._path = path
        self._flight = f"{flight.recording.name}, {_sha256(flight.recording)}"
        self._seeds = list(seeds)
        self.document: dict[str, Any] = {
            "schema": SCHEMA,
            "flight": self._flight,
            "simulated": True,
            "duration_s": flight.duration_s,
            "seeds": self._seeds,
            "borne_from": BORNE,
            "machine": machine(),
            "axes": {},
            "trials": [],
        }
        if path.exists():
            self._take_up(path, undisturbed)

    def _take_up(self, path: Path, undisturbed: float | None) -> None:
        before, mine = read(path), self.document
        for name in ("flight", "duration_s", "seeds"):
            if before.get(name) != mine[name]:
                raise GroundStationError(
                    f"{path}: its {name} is {before.get(name)} and not {mine[name]}: name another"
                    " file, or delete this one"
                )
        for name in ("cores", "model"):
            if before["machine"].get(name) != mine["machine"][name]:
                raise GroundStationError(f"{path}: measured on another machine: name another file")
        mine["machine"], mine["axes"] = before["machine"], before["axes"]
        for trial in before["trials"]:
            others = trial["measured"]["others_cores"]
            if undisturbed is None or (others is not None and others <= undisturbed):
                mine["trials"].append(trial)

    def measured(self, level: Level, seed: int) -> Measured | None:
        """An earlier trial's result; None when there is none."""
        key = _key(level, seed)
        for trial in self.document["trials"]:
            if trial["key"] == key:
                return Measured(**trial["measured"])
        return None

    def add(self, axis: Axis, level: Level, seed: int, measured: Measured) -> None:
        """Keeps a trial, on disk at once."""
        self.document["trials"].append(
            {
                "axis": axis.name,
                "level": level.text,
                "seed": seed,
                "key": _key(level, seed),
                "measured": asdict(measured),
            }
        )
        self.write()

    def conclude(self, axis: Axis, found: Found, *, complete: bool, problem: str = "") -> None:
        """Keeps what is known of an axis."""
        text = [level.text for level in axis.levels]
        sustained, refused = found.sustained, found.refused
        self.document["axes"][axis.name] = {
            "title": axis.title,
            "complete": complete,
            "problem": problem,
            "sustained": None if sustained is None else text[sustained],
            "refused": None if refused is None else text[refused],
            "last": sustained is not None and sustained == len(text) - 1,
            "odd": [text[n] for n in found.odd],
            "shares": {text[n]: list(one.shares) for n, one in sorted(found.tried.items())},
            **self._beside(axis, found),
        }
        self.write()

    def _beside(self, axis: Axis, found: Found) -> dict[str, Any]:
        """What used the machine meanwhile, and how a process was held back."""
        keys = {_key(axis.levels[n], seed) for n in found.tried for seed in self._seeds}
        trials = [t["measured"] for t in self.document["trials"] if t["key"] in keys]
        others = [t["others_cores"] for t in trials if t["others_cores"] is not None]
        return {
            "held_by": sorted({trial["held_by"] for trial in trials if trial["held_by"]}),
            "others_cores_most": round(max(others), 2) if others else None,
        }

    def write(self) -> None:
        """Writes the document, beside and renamed."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        write_json(self._path, self.document)


def read(path: Path) -> dict[str, Any]:
    """A document that was kept; raises `GroundStationError` with one line for another file."""
    try:
        document = json.loads(path.read_text())
        if not isinstance(document, dict) or document.get("schema") != SCHEMA:
            raise ValueError(f"its schema is not {SCHEMA}")
        if not all(isinstance(document[name], dict) for name in ("axes", "machine")):
            raise ValueError("it has no axes or no machine")
        for trial in document.get("trials", []):
            Measured(**trial["measured"])
        return document
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise GroundStationError(f"{path}: no document of limits: {error}") from None


def _key(level: Level, seed: int) -> str:
    under = json.dumps(asdict(level.under), sort_keys=True)
    return f"{under} seed {seed}"


def _sha256(path: Path) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()[:16]
    except OSError as error:
        raise GroundStationError(f"{path}: {error.strerror or error}") from None


BLOCK = Block(
    "<!-- limits: made by `make limits` and its --accept; do not edit -->",
    "<!-- limits: end -->",
)
ACCEPTED = Path(__file__).with_name("limits_accepted.json")
README = Path(__file__).resolve().with_name("README.md")
QUIET_CORES = 0.2
"""What others may use of the machine during any trial of a run that is accepted."""


def render(document: dict[str, Any]) -> str:
    """The table in Markdown, with the machine and the conditions in a sentence before it."""
    machine, seeds = document["machine"], document["seeds"]
    others = [axis["others_cores_most"] or 0.0 for axis in document["axes"].values()]
    model = str(machine["model"]).replace("|", "/")
    said = (
        f"Sustained is the highest level at which at least {100 * document['borne_from']:g} %"
        f" of the captured frames are TRACKING in each of {len(seeds)} runs of"
        f" {document['duration_s']:g} s, counted from the first TRACKING one, and at all easier"
        " levels that were tried; a level is given up at the first run that falls short. Measured"
        f" by `make limits` with a simulated flight ({document['flight'].split(',')[0]}) on"
        f" {machine['cores']} cores ({model}), {machine['date']}, load"
        f" {machine['load_before']:g} before; others used {max(others, default=0.0):.2f} cores at"
        " most meanwhile. Of a link only the video's packets are burdened."
    )
    rows = [("burden", "sustained", "TRACKING there", "not sustained", "TRACKING there")]
    notes: list[str] = []
    for axis in document["axes"].values():
        shares = axis["shares"]
        sustained, refused = axis["sustained"], axis["refused"]
        name = axis["title"]
        if axis["odd"]:
            notes.append(
                f"Not monotonic: {name}: {', '.join(axis['odd'])} is sustained beyond {refused}."
            )
            name += " (see below)"
        least = "more was not tried" if axis["last"] else "none of those tried"
        at_borne, at_refused = _spread(shares.get(sustained)), _spread(shares.get(refused))
        rows.append((name, sustained or "nothing", at_borne, refused or least, at_refused))
    held = sorted({by for axis in document["axes"].values() for by in axis["held_by"]})
    if held:
        notes.append(f"The processor was held back by {' and '.join(held)}.")
    return "\n".join([f"{said}\n", markdown(rows), *([" ".join(notes) + "\n"] if notes else [])])


def _spread(shares: list[float] | None) -> str:
    """Least to most, in percent; rounded away from what would make a missed bound look kept."""
    if not shares:
        return "–"
    least, most = int(1000 * min(shares)) / 10, int(1000 * max(shares)) / 10
    return f"{least:g} %" if least == most else f"{least:g} to {most:g} %"


def accept(document: dict[str, Any], readme: Path = README, accepted: Path = ACCEPTED) -> None:
    """Makes a run the one that README shows.

    Raises `GroundStationError` in one line for a run that was interrupted or disturbed, and for a
    README without the two markers.
    """
    for name, axis in document["axes"].items():
        if not axis["complete"]:
            raise GroundStationError(f"limits: {name} was not measured to its end: not accepted")
        others = axis["others_cores_most"]
        if others is None or others > QUIET_CORES:
            raise GroundStationError(
                f"limits: {name}: others used {others} cores of the machine meanwhile, at most"
                f" {QUIET_CORES:g} are accepted: measure again with --undisturbed when it is quiet"
            )
    if not document["axes"]:
        raise GroundStationError("limits: nothing was measured: not accepted")
    kept = {name: value for name, value in document.items() if name != "trials"}
    BLOCK.write(readme, render(kept))
    write_json(accepted, kept)
