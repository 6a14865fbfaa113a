"""CPython's own memory kept from growing over a long flight.

CPython puts freed tuples by for later use, up to 2,000 of each length. A tuple that is made longer
than needed and then cut, as `tuple(generator)` and many calls into C do, is taken from one list and
put into another, which fills and is of no use to anybody. Only a full collection empties these
lists, and by itself none came in five minutes of a flight: it waits until what is new is a quarter
of all there is, and a payload in flight makes next to no garbage that has cycles.
"""

from __future__ import annotations

import gc


def freeze() -> None:
    """Takes all that lives now, modules above all, out of later collections: they become short.

    Called once, when all is loaded. What is open by then must stay so until the program ends.
    """
    gc.collect()
    gc.freeze()


def collect() -> None:
    """Collects what has cycles and empties CPython's lists of freed objects."""
    gc.collect()
