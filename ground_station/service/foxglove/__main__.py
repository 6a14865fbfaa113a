"""`python -m ground_station.service.foxglove RUN_FOLDER`: the live channel for other programs."""

from __future__ import annotations

import contextlib
import os
import sys
from pathlib import Path

from ground_station.service.ending import ending
from pi_firmware.wire.errors import BlimpError

_BAD_INPUT = 2


def main(arguments: list[str]) -> int:
    """Serves until it is told to end; 0, or 2 for bad input."""
    if len(arguments) != 1:
        print("usage: python -m ground_station.service.foxglove RUN_FOLDER", file=sys.stderr)
        return _BAD_INPUT
    stop = ending()
    # As in `blimp`: threads are ours to schedule, and BLAS reads this when numpy is imported.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    import cv2

    from ground_station.service import processes, settings
    from ground_station.service.bus import Bus
    from ground_station.service.foxglove.process import Publishing

    cv2.setNumThreads(1)
    folder = Path(arguments[0])
    try:
        run = settings.load_run(folder)
        with Bus(folder, processes.FOXGLOVE) as bus:
            publishing = Publishing(bus, folder, run.station)
            with contextlib.closing(publishing):
                chosen = run.station.foxglove
                print(f"foxglove: ws://{chosen.host}:{publishing.server.port}", flush=True)
                publishing.run(stop)
    except BlimpError as error:
        print(f"foxglove: {error}", file=sys.stderr, flush=True)
        return _BAD_INPUT
    return 0


if __name__ == "__main__":
    status = main(sys.argv[1:])
    sys.stdout.flush()
    os._exit(status)  # not waiting for a map that is being read
