"""Long jobs that the page starts: one at a time, beside the flight and after the page.

A job is a process of its own with a log in the run's folder. It holds a lock on that log for as
long as it lives, so that a web process that was started again finds it, and what became of it. It
gives way to the flight: lower priority, and the first to go where memory ends.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fastapi import APIRouter

from ground_station.errors import GroundStationError
from ground_station.service.web.guide import Guide
from ground_station.service.web.models import AnswerModel, GuideModel, JobRequest
from ground_station.service.web.problems import Busy, problems
from ground_station.service.web.snapshot import Snapshot
from pi_firmware.wire import files
from pi_firmware.wire.text import printable

_SCRIPT = """\
echo 500 >/proc/self/oom_score_adj 2>/dev/null
nice -n 10 "$@"
echo $? >"$JOB_STATUS"
"""
_TAIL_BYTES = 4096
_STOP_S = 3.0
_COUNT = re.compile(r"(\d+) of (\d+)")
_ADDRESS = re.compile(r"http://127\.0\.0\.1:\d+/\S*")


class Jobs:
    """The job of a run's folder. Safe from any thread."""

    def __init__(self, folder: Path) -> None:
        self._about, self._log, self._status = (
            folder / f"job.{end}" for end in ("json", "log", "status")
        )
        self._lock = threading.Lock()
        self._child: subprocess.Popen[bytes] | None = None

    def start(self, step: str, words: Sequence[str]) -> None:
        """Starts `blimp …`; raises `Busy` while another job runs."""
        with self._lock:
            if self._runs():
                raise Busy("another job runs; stop it, or wait for its end")
            self._status.unlink(missing_ok=True)
            command = [sys.executable, "-m", "ground_station.cli", *words[1:]]
            with self._log.open("wb") as log:
                fcntl.flock(log, fcntl.LOCK_EX)  # the process has it, too, and keeps it
                self._child = subprocess.Popen(
                    ["sh", "-c", _SCRIPT, "job", *command],
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    start_new_session=True,
                    env={**os.environ, "JOB_STATUS": str(self._status), "PYTHONUNBUFFERED": "1"},
                )
            about = {"step": step, "command": shlex.join(words), "pid": self._child.pid}
            about["started_ns"] = time.time_ns()
            with files.replacing(self._about) as part:
                part.write_text(json.dumps(about))

    def stop(self) -> None:
        """Ends it as Ctrl-C would, or after 3 s the hard way; raises where none runs."""
        with self._lock:
            about = self._read()
            if about is None or not self._runs():
                raise GroundStationError("no job runs")
            for number in (signal.SIGINT, signal.SIGKILL):
                with contextlib.suppress(OSError):
                    os.killpg(int(about["pid"]), number)
                until_s = time.monotonic() + _STOP_S
                while self._runs() and time.monotonic() < until_s:
                    time.sleep(0.05)

    def state(self) -> dict[str, Any] | None:
        """The job of now, or the last one; None before the first.

        `line` is the last that it said, `share` how far that is, and `page` where it is to be
        gone on with, each "" or None where it says none; `status` is its exit status.
        """
        with self._lock:
            about = self._read()
            if about is None:
                return None
            runs = self._runs()
            status: int | None = None
            with contextlib.suppress(OSError, ValueError):
                status = int(self._status.read_text())
            lines = self._tail()
        said = [line for line in lines if line.strip()]
        count = _COUNT.search(said[-1]) if runs and said else None
        address = _ADDRESS.search("\n".join(said)) if runs else None
        return {
            "step": str(about["step"]),
            "command": str(about["command"]),
            "started_ns": int(about["started_ns"]),
            "running": runs,
            "status": status,
            "line": said[-1] if said else "",
            "share": int(count[1]) / max(1, int(count[2])) if count else None,
            "page": address[0] if address else "",
        }

    def close(self) -> None:
        """At the service's end, which the job does not outlive."""
        with contextlib.suppress(GroundStationError, OSError):
            self.stop()

    def _runs(self) -> bool:
        if self._child is not None and self._child.poll() is not None:
            self._child = None
        try:
            with self._log.open("rb") as log:
                fcntl.flock(log, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return False
        except BlockingIOError:
            return True
        except OSError:
            return False

    def _read(self) -> dict[str, Any] | None:
        try:
            about = json.loads(self._about.read_bytes())
        except (OSError, ValueError):
            return None
        return about if isinstance(about, dict) else None

    def _tail(self) -> list[str]:
        with contextlib.suppress(OSError), self._log.open("rb") as log:
            size = log.seek(0, os.SEEK_END)
            log.seek(max(0, size - _TAIL_BYTES))
            text = log.read(_TAIL_BYTES).decode(errors="replace")
            return [printable(line, 300, " ") for line in text.replace("\r", "\n").split("\n")]
        return []


def router(guide: Guide, jobs: Jobs, snapshot: Snapshot) -> APIRouter:
    """The guide and its jobs over HTTP."""
    result = APIRouter(prefix="/api", tags=["guide"])

    @result.get("/guide", response_model=GuideModel)
    def steps() -> Any:
        """The steps from payload to flight."""
        return {"folder": str(Path.cwd()), "steps": guide.steps(snapshot.document(full=False))}

    @result.post("/job", response_model=AnswerModel, responses=problems(404, 409, 413))
    def start(request: JobRequest) -> Any:
        """Starts a long job, which goes on when the page is closed."""
        station = snapshot.document(full=False)
        words = guide.job(station, request.step, request.choice, request.map or "")
        browser = ["--no-browser"] if request.step == "register" else []
        jobs.start(request.step, [*words, *browser])
        return {"done": True, "reason": "", "values": {}}

    @result.delete("/job", response_model=AnswerModel, responses=problems(409))
    def stop() -> Any:
        """Stops the job; what it had finished stays."""
        jobs.stop()
        return {"done": True, "reason": "", "values": {}}

    return result
