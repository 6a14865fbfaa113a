"""The scenes by name, and interiors by number."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from ground_station.simulator.atrium import build_atrium
from ground_station.simulator.board import build_board
from ground_station.simulator.corridor import build_corridor
from ground_station.simulator.hall import build_hall
from ground_station.simulator.interiors import KINDS, build_interior
from ground_station.simulator.office import build_office
from ground_station.simulator.rooms import build_rooms
from ground_station.simulator.scene import Scene, SimulatorError

SCENES: dict[str, Callable[[float], Scene]] = {
    "atrium": build_atrium,
    "office": build_office,
    "corridor": build_corridor,
    "hall": build_hall,
    "hall-glazed": partial(build_hall, glazed=True),
    "hall-above": partial(build_hall, above=True),
    "hall-above-alike": partial(build_hall, above=True, alike=True),
    "rooms": build_rooms,
    "board": build_board,
    "atrium-moved-25": partial(build_atrium, moved=0.25),
    "atrium-moved-50": partial(build_atrium, moved=0.5),
    "atrium-moved": partial(build_atrium, moved=1.0),
    "atrium-moved-posted": partial(build_atrium, moved=1.0, posted=True),
}
_DIGITS = 3


def build(name: str, texels_per_m: float) -> Scene:
    """The scene of that name; raises `SimulatorError` naming those there are."""
    kind, _, number = name.partition("-")
    is_interior = kind in KINDS and number.isdecimal() and len(number) <= _DIGITS
    if name not in SCENES and not is_interior:
        known = ", ".join([*SCENES, *(f"{kind}-N" for kind in KINDS)])
        raise SimulatorError(f"scene '{name}' is unknown; there are: {known}")
    if not 5 <= texels_per_m <= 400:
        raise SimulatorError(f"{texels_per_m} texels per metre; allowed: 5 to 400")
    if is_interior:
        return build_interior(kind, int(number), texels_per_m)
    return SCENES[name](texels_per_m)
