"""`python -m ground_station.service.intake RUN_FOLDER`: the intake as a process of the service."""

from __future__ import annotations

import sys
import threading
from pathlib import Path

from ground_station.service import bus_messages
from ground_station.service.bus import Bus
from ground_station.service.bus_messages import EstimateMessage, EventMessage, LeaveMessage
from ground_station.service.cameras import camera_of
from ground_station.service.ending import ending, few_heaps, status_of
from ground_station.service.intake import resuming
from ground_station.service.intake.process import Intake
from ground_station.service.settings import load_run

_STEP_S = 0.1


def serve(run_folder: str) -> int:
    """Runs until it is told to end; raises a `BlimpError` with one line when it cannot."""
    few_heaps()
    stop = ending(None)  # a recording ends in its own time
    import cv2

    cv2.setNumThreads(1)  # a table over one picture is not worth a second thread
    folder = Path(run_folder)
    run = load_run(folder)
    settings = run.station
    camera = camera_of(settings.map, settings.map.folder)
    with (
        Bus(folder, "intake", lossless=run.stepped) as bus,
        Intake(settings, bus.publish, folder=folder, camera=camera, stepped=run.stepped) as intake,
    ):
        bus.serve("intake", intake.ask)
        bus.subscribe(bus_messages.ESTIMATE, EstimateMessage, intake.estimated)
        bus.subscribe(bus_messages.EVENT, EventMessage, intake.heard_event)
        bus.subscribe(bus_messages.LEAVE, LeaveMessage, intake.leave)
        # A disk that hangs, or is full, does not hold up the video.
        about = (intake.recorder, settings.recording, intake.report)
        threading.Thread(target=resuming.begin, args=about, daemon=True).start()
        while not stop.wait(_STEP_S):
            intake.step()
            bus.heartbeat()
    return 0


if __name__ == "__main__":
    sys.exit(status_of("intake", serve))
