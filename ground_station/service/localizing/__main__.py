"""`python -m ground_station.service.localizing RUN_FOLDER PAYLOAD_ID`: one payload's localizer."""

from __future__ import annotations

import os
import sys
import traceback
from pathlib import Path

from ground_station.service.ending import ending, large_blocks_apart, status_of
from pi_firmware.wire.errors import BlimpError


def serve(run_folder: str, payload_id: str) -> int:
    """Localizes until it is told to end; 0, or 3 when only a new process can help."""
    stop = ending()
    import cv2

    from ground_station.service import processes, settings
    from ground_station.service.bus import Bus
    from ground_station.service.localizing.process import RESTART, Localizing
    from pi_firmware.wire.keys import check_payload_id

    cv2.setNumThreads(1)
    large_blocks_apart()
    folder, name = Path(run_folder), f"{processes.LOCALIZER}/{check_payload_id(payload_id)}"
    try:
        run = settings.load_run(folder)
        with Bus(folder, name, lossless=run.stepped) as bus:
            return Localizing(bus, folder, payload_id, run).run(stop)
    except BlimpError:
        raise
    except Exception:  # the supervisor starts a new one, and its log says why
        traceback.print_exc()
        return RESTART


if __name__ == "__main__":
    status = status_of(f"localizer {sys.argv[-1]}", serve)
    sys.stdout.flush()
    # Not sys.exit: it waits for the thread of keyframes, which may be in a search.
    os._exit(status)
