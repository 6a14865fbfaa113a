"""`python -m ground_station.service.foxglove RUN_FOLDER`: the live channel for other programs."""

from __future__ import annotations

import contextlib
import os
import sys
from pathlib import Path

from ground_station.service.ending import ending, status_of


def serve(run_folder: str) -> int:
    """Serves until it is told to end."""
    stop = ending()
    import cv2

    from ground_station.service import processes, settings
    from ground_station.service.bus import Bus
    from ground_station.service.foxglove.process import Publishing

    cv2.setNumThreads(1)
    folder = Path(run_folder)
    run = settings.load_run(folder)
    with Bus(folder, processes.FOXGLOVE) as bus:
        publishing = Publishing(bus, folder, run.station)
        with contextlib.closing(publishing):
            chosen = run.station.foxglove
            print(f"foxglove: ws://{chosen.host}:{publishing.server.port}", flush=True)
            publishing.run(stop)
    return 0


if __name__ == "__main__":
    status = status_of("foxglove", serve)
    sys.stdout.flush()
    os._exit(status)  # not waiting for a map that is being read
