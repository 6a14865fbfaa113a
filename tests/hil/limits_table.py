"""The limits as README shows them: a table made of an accepted run, between two markers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ground_station.errors import GroundStationError
from ground_station.files import write_json
from ground_station.presentation.readme import Block
from ground_station.presentation.text import markdown

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
        f"Borne is the highest level at which at least {100 * document['borne_from']:g} % of the"
        f" captured frames are TRACKING in each of {len(seeds)} runs of"
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
