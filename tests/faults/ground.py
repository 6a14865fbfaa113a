"""The ground's end of a flight: a receiver and a listener that keep what they were shown.

    python tests/faults/ground.py --port 5600 --listen tcp/127.0.0.1:7447

is the same as a process that can be killed: it prints its ports and then each frame, as JSON lines.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from numbered_flight import number_in
from receiving import Receiver

from ground_station.stream.telemetry import TelemetryListener

_QUEUE_FRAMES = 1024
_START_LIMIT_S = 30.0


@dataclass(frozen=True)
class Seen:
    """One frame that the receiver gave out; `number` is what its picture says, -1 unread.

    That of a damaged one is not read: it may stand in what is not as it was sent.
    """

    sequence: int
    number: int
    ssrc: int
    time_ns: int
    clock_ns: int
    arrival_ns: int
    damaged: bool = False


class Gallery:
    """The frames seen so far. Safe from any thread."""

    def __init__(self) -> None:
        self._frames: list[Seen] = []
        self._changed = threading.Condition()

    @property
    def frames(self) -> list[Seen]:
        """All of them, in the order in which they were given out."""
        with self._changed:
            return list(self._frames)

    def add(self, seen: Seen) -> None:
        """Keeps one more."""
        with self._changed:
            self._frames.append(seen)
            self._changed.notify_all()

    def wait_for(self, wanted: Callable[[Seen], bool], within_s: float) -> Seen | None:
        """The first frame from now on that is wanted; None when there is none in time."""
        until_s = time.monotonic() + within_s
        with self._changed:
            at = len(self._frames)
            while True:
                found = next((frame for frame in self._frames[at:] if wanted(frame)), None)
                at = len(self._frames)
                left_s = until_s - time.monotonic()
                if found or left_s <= 0:
                    return found
                self._changed.wait(left_s)


class Ground(Gallery):
    """In this process; a context manager. `numbered` reads each picture's number."""

    def __init__(
        self,
        port: int = 0,
        listen: str = "tcp/127.0.0.1:0",
        *,
        ssrc: int | None = None,
        numbered: bool = True,
    ) -> None:
        super().__init__()
        self._numbered = numbered
        self.listener = TelemetryListener([listen])
        self.receiver = Receiver(port, queue_frames=_QUEUE_FRAMES, ssrc=ssrc)
        self.port = self.receiver.port
        self.endpoints = list(self.listener.endpoints)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="ground", daemon=True)
        self._thread.start()

    def __enter__(self) -> Ground:
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        self._thread.join()
        self.receiver.close()
        self.listener.close()

    def _run(self) -> None:
        while not self._closing.is_set():
            frame = self.receiver.get(0.1)
            if frame is not None:
                damaged = frame.damaged is not None
                self.add(
                    Seen(
                        frame.sequence,
                        number_in(frame.image) if self._numbered and not damaged else -1,
                        frame.ssrc,
                        frame.time_ns,
                        frame.clock_ns,
                        frame.arrival_ns,
                        damaged,
                    )
                )


class GroundProcess(Gallery):
    """The same as a process of its own, for those who kill it; a context manager."""

    def __init__(self, port: int = 0, listen: str = "tcp/127.0.0.1:0") -> None:
        super().__init__()
        here = Path(__file__)
        path = os.pathsep.join([str(here.parents[1] / "stream"), os.environ.get("PYTHONPATH", "")])
        self.process = subprocess.Popen(
            [sys.executable, str(here), "--port", str(port), "--listen", listen],
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": path},
        )
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()
        if not self._ready.wait(_START_LIMIT_S) or self.process.poll() is not None:
            self.kill()
            raise AssertionError("the ground's process did not start")

    def __enter__(self) -> GroundProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()

    def kill(self) -> None:
        """SIGKILL; a second call does nothing."""
        self.process.kill()
        self.process.wait()
        self._thread.join()

    def _read(self) -> None:
        assert self.process.stdout is not None
        with self.process.stdout as lines:
            for line in lines:
                if not line.endswith("\n"):
                    continue  # it was killed while it wrote
                document = json.loads(line)
                if "endpoints" in document:
                    self.port: int = document["port"]
                    self.endpoints: list[str] = document["endpoints"]
                    self._ready.set()
                else:
                    self.add(Seen(**document))
        self._ready.set()


def main() -> None:
    """Receives until it is killed."""
    parser = argparse.ArgumentParser(description="The ground's end of a test flight.")
    parser.add_argument("--port", type=int, default=0)
    parser.add_argument("--listen", default="tcp/127.0.0.1:0")
    arguments = parser.parse_args()
    with Ground(arguments.port, arguments.listen) as ground:
        print(json.dumps({"port": ground.port, "endpoints": ground.endpoints}), flush=True)
        told = 0
        while True:
            ground.wait_for(lambda _: True, 0.5)
            for seen in ground.frames[told:]:
                print(json.dumps(dataclasses.asdict(seen)), flush=True)
                told += 1


if __name__ == "__main__":
    main()
