"""The pipeline's clock against the wall clock, so that a sensor's time becomes the payload's."""

from __future__ import annotations

import time
from typing import Any

_GOOD_NS = 100_000  # a tenth of the millisecond that capture times are good for
_ATTEMPTS = 5


def wall_at(pipeline: Any, running_ns: int) -> int:
    """The wall clock, ns since 1970, when the pipeline's running time was `running_ns`.

    The two clocks cannot be read at once, and the thread may be held between: of up to five tries
    the one counts whose reading of the wall clock is framed most tightly. A wall clock that was set
    again since shifts the result by as much: it is the wall clock of now that is meant.
    """
    clock = pipeline.get_clock()
    best_ns, offset_ns = 1 << 62, 0
    for _ in range(_ATTEMPTS):
        before_ns = clock.get_time()
        wall_ns = time.time_ns()
        after_ns = clock.get_time()
        if after_ns - before_ns < best_ns:
            best_ns = after_ns - before_ns
            offset_ns = wall_ns - (before_ns + after_ns) // 2
        if best_ns < _GOOD_NS:
            break
    return int(pipeline.get_base_time() + running_ns + offset_ns)
