"""Faults as steps that can be put together, across the payload and the whole service.

`matrix` names scenarios, `walk` draws them by seed; `world` is what they befall, `play` lets them
happen, and `judge` says which of the invariants held:

 1. accounts    every frame is accounted for: payload, intake, localizer;
 2. poses       none called TRACKING is more than 0.5 m from the truth;
 3. recordings  of service and payload can be read, and lack nothing but the last second;
 4. recovery    video, telemetry, page and TRACKING are back within a bound after the last fault;
 5. order       no unhandled exception, no process, port or shared memory left.
"""

import sys
from pathlib import Path

_TESTS = Path(__file__).parents[2]
for _room in ("faults", "pi_firmware", "service", "stream"):
    if str(_TESTS / _room) not in sys.path:
        sys.path.insert(0, str(_TESTS / _room))
