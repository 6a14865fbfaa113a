"""The corridor: 28 x 4 x 3 m, seven bays of one kind, to tell whether a map knows them apart.

Doors, posters, pilasters and benches are in the same places of every bay and equal prints.
What differs is what differs in a building, too: the paint and the dirt on it, the floor. x runs
along the corridor, z up; the origin is the south-west corner on the floor. Plan: `corridor`.
"""

from __future__ import annotations

from ground_station.simulator.building import SceneBuilder
from ground_station.simulator.scene import Scene

BAYS, BAY_M = 7, 4.0
LENGTH_M, WIDTH_M, HEIGHT_M = BAYS * BAY_M, 4.0, 3.0
TEXTURE_SEED = 77011

_WHITE, _GREY, _GREEN = (0.72, 0.72, 0.70), (0.45, 0.45, 0.46), (0.20, 0.33, 0.18)
_DOOR, _LEFT, _RIGHT, _FRAME = 1_000_001, 1_000_002, 1_000_003, 1_000_004


def _bay(b: SceneBuilder, x: float, number: int) -> None:
    """Walls, floor and ceiling of one bay, and what hangs there."""
    north, south = WIDTH_M, 0.0
    b.rectangle([x, north, 0], [BAY_M, 0, 0], [0, 0, HEIGHT_M], "plaster", rgb=_WHITE)
    b.rectangle([x + BAY_M, south, 0], [-BAY_M, 0, 0], [0, 0, HEIGHT_M], "plaster", rgb=_WHITE)
    b.rectangle([x, 0, 0], [BAY_M, 0, 0], [0, WIDTH_M, 0], "terrazzo", slab_m=0.8, rgb=_GREY,
                detail=0.7)  # fmt: skip
    b.rectangle([x, WIDTH_M, HEIGHT_M], [BAY_M, 0, 0], [0, -WIDTH_M, 0], "plaster", rgb=_WHITE,
                detail=0.6)  # fmt: skip
    b.rectangle([x + 0.5, north - 0.03, 0], [1.0, 0, 0], [0, 0, 2.1], "door", text="STAFF",
                detail=1.3, print=_DOOR)  # fmt: skip
    for k, a in enumerate((x + 0.42, x + 1.5)):
        b.rectangle([a, north - 0.05, 0], [0.08, 0, 0], [0, 0, 2.18], "wood", upright=True,
                    print=_FRAME + k)  # fmt: skip
    b.box([x - 0.15, north - 0.22, 0], [x + 0.15, north, HEIGHT_M], "concrete", rgb=_GREY,
          faces=("-y", "-x", "+x"), print=_FRAME + 10)  # fmt: skip
    b.box([x + 2.0, north - 0.5, 0.4], [x + 3.8, north - 0.08, 0.5], "wood", print=_FRAME + 20)
    b.sign(f"sign-{number}", [x + 1.8, north - 0.02, 0.9], [0.85, 0, 0], [0, 0, 1.2], "SAFETY",
           print=_LEFT)  # fmt: skip
    b.rectangle([x + 2.85, north - 0.02, 0.7], [1.0, 0, 0], [0, 0, 1.6], "poster", text="NEWS",
                detail=1.6, print=_RIGHT)  # fmt: skip
    b.rectangle([x + 3.0, south + 0.03, 0], [-1.0, 0, 0], [0, 0, 2.1], "door", text="STORE",
                detail=1.3, print=_DOOR + 10)  # fmt: skip


def build_corridor(texels_per_m: float) -> Scene:
    """The scene `corridor`."""
    b = SceneBuilder(texels_per_m)
    for number in range(BAYS):
        x = BAY_M * number
        _bay(b, x, number)
        for dx in (1.0, 3.0):
            b.lamps.append((x + dx, WIDTH_M / 2, HEIGHT_M - 0.12))
            b.box([x + dx - 0.6, WIDTH_M / 2 - 0.1, HEIGHT_M - 0.1],
                  [x + dx + 0.6, WIDTH_M / 2 + 0.1, HEIGHT_M - 0.02], "metal", rgb=_WHITE,
                  print=_DOOR + 20)  # fmt: skip
    b.rectangle([0, 0, 0], [0, WIDTH_M, 0], [0, 0, HEIGHT_M], "brick")
    b.rectangle([LENGTH_M, WIDTH_M, 0], [0, -WIDTH_M, 0], [0, 0, HEIGHT_M], "plaster", rgb=_GREEN)
    b.outer_walls(LENGTH_M, WIDTH_M)
    return b.scene("corridor", (LENGTH_M, WIDTH_M, HEIGHT_M), TEXTURE_SEED)
