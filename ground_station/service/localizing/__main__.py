"""`python -m ground_station.service.localizing RUN_FOLDER PAYLOAD_ID`: one payload's localizer."""

from __future__ import annotations

import os
import sys
import traceback
from pathlib import Path

from ground_station.service.ending import ending
from pi_firmware.wire.errors import BlimpError

_BAD_INPUT = 2


def main(arguments: list[str]) -> int:
    """Localizes until it is told to end; 0, 2 for bad input, 3 when only a new process can help."""
    if len(arguments) != 2:
        usage = "usage: python -m ground_station.service.localizing RUN_FOLDER PAYLOAD_ID"
        print(usage, file=sys.stderr)
        return _BAD_INPUT
    stop = ending()
    # As in `blimp`: threads are ours to schedule, and BLAS reads this when numpy is imported.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    import cv2

    from ground_station.service import heaps, processes, settings
    from ground_station.service.bus import Bus
    from ground_station.service.localizing.process import RESTART, Localizing
    from pi_firmware.wire.keys import check_payload_id

    cv2.setNumThreads(1)
    heaps.large_apart()
    folder, payload_id = Path(arguments[0]), arguments[1]
    try:
        check_payload_id(payload_id)
        run = settings.load_run(folder)
        name = f"{processes.LOCALIZER}/{payload_id}"
        with Bus(folder, name, lossless=run.stepped) as bus:
            return Localizing(bus, folder, payload_id, run).run(stop)
    except BlimpError as error:
        print(f"localizer {payload_id}: {error}", file=sys.stderr, flush=True)
        return _BAD_INPUT
    except Exception:  # the supervisor starts a new one, and its log says why
        traceback.print_exc()
        return RESTART


if __name__ == "__main__":
    status = main(sys.argv[1:])
    sys.stdout.flush()
    # Not sys.exit: it waits for the thread of keyframes, which may be in a search.
    os._exit(status)
