"""Images that structure from motion put into a place which only looks like theirs.

Two doors of one kind give pairs of images that a two-view geometry explains well; only it is that
of another place. What gives them away is the way between: an image's landmarks must be where the
image beside it saw them. Images for which that holds from one to the next are a piece; a piece that
the chain contradicts where it meets a larger one is in the wrong place. Heinly, Dunn and Frahm,
"Correcting for duplicate scene structure in sparse 3D reconstruction", ECCV 2014, judge by the
landmarks that an image should see and does not. Where there is a chain, it says it with less doubt.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from ground_station.mapping.construction.pairs import Pair
from ground_station.mapping.construction.placing.chains import components
from ground_station.mapping.construction.placing.placed import Placed
from ground_station.mapping.sfm.two_view import TwoView

SPEAKS = 15
"""Fewer landmarks in common say nothing about two images."""
HOLDS, BREAKS = 0.5, 0.2
"""Shares of the landmarks in common that are in their place: of a link that holds, and of one that
does not. Between the two a link says nothing."""
_PIECE = 5
"""Images that hold together by themselves; fewer hang by their poses."""


def misplaced(model: Placed, links: Iterable[Pair], pairs: Mapping[Pair, TwoView]) -> set[int]:
    """The images, by index, that the chain says are in the wrong place; empty where none is.

    From the largest piece to the smallest, each is believed unless a link breaks between it and a
    piece that is believed already.
    """
    holding, broken = _judged(model, links, pairs)
    piece = components([np.array(holding, np.int64).reshape(-1, 2)], len(model.landmark))
    against: dict[int, set[int]] = {}
    for i, j in broken:
        one, other = int(piece[i]), int(piece[j])
        if one != other:
            against.setdefault(one, set()).add(other)
            against.setdefault(other, set()).add(one)
    placed = np.array(sorted(model.wTc), dtype=np.int64)
    size = np.bincount(piece[placed], minlength=len(model.landmark))
    believed: set[int] = set()
    for number in np.argsort(-size, kind="stable").tolist():
        if not against.get(number, set()) & believed:
            believed.add(number)
    return {int(k) for k in placed if int(piece[k]) not in believed}


def pieces(model: Placed, chosen: Iterable[Pair], pairs: Mapping[Pair, TwoView]) -> list[set[int]]:
    """The model's images, by index, in sets that the chosen pairs hold together; not the few."""
    holding, _ = _judged(model, chosen, pairs)
    piece = components([np.array(holding, np.int64).reshape(-1, 2)], len(model.landmark))
    placed = np.array(sorted(model.wTc), dtype=np.int64)
    sets = [{*placed[piece[placed] == number].tolist()} for number in np.unique(piece[placed])]
    return [each for each in sets if len(each) >= _PIECE]


def _judged(
    model: Placed, chosen: Iterable[Pair], pairs: Mapping[Pair, TwoView]
) -> tuple[list[Pair], list[Pair]]:
    """Which of the chosen pairs hold in the model, and which are broken."""
    holding: list[Pair] = []
    broken: list[Pair] = []
    for pair in sorted(chosen):
        if {*pair} <= model.wTc.keys():
            good, total = model.in_place(pair, pairs[pair])
            if total >= SPEAKS and good >= HOLDS * total:
                holding.append(pair)
            elif total >= SPEAKS and good <= BREAKS * total:
                broken.append(pair)
    return holding, broken


def refuted(
    model: Placed, wrong: set[int], links: set[Pair], pairs: Mapping[Pair, TwoView]
) -> set[Pair]:
    """The pairs that put the misplaced where they are; what they say is not so."""
    found = set()
    for pair, view in pairs.items():
        i, j = pair
        if (i in wrong) == (j in wrong) or pair in links or not {i, j} <= model.wTc.keys():
            continue
        good, total = model.in_place(pair, view)
        if total and good >= HOLDS * total:
            found.add(pair)
    return found
