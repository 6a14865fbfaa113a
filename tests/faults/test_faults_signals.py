"""SIGTERM and SIGKILL at any moment: an orderly end within 5 s, and a successor that streams."""

from __future__ import annotations

import json
import os
import random
import signal
import socket
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from flight import FRESH_S
from ground import Ground
from payload_process import STOP_S, PayloadProcess, free_port

TERMINATED, KILLED = 26, 24  # 50 moments, and each killed one's successor is terminated, too
START_UP_S, FLYING_S = 0.5, 2.5
WORKERS = 4
SMALL = (
    "camera.uri=test:",
    "camera.width_px=160",
    "camera.height_px=120",
    "camera.rate_hz=15",
    "battery.period_s=0.2",
)


def moment_s(index: int) -> float:
    """When a process is met, seconds after its start: every second one while it starts."""
    draw = random.Random(f"moment {index}")
    return draw.uniform(0, FLYING_S if index % 2 else START_UP_S)


def handles_sigterm(pid: int) -> bool:
    """Whether a process has a handler of its own for SIGTERM (proc(5), SigCgt)."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    caught = int(next(line for line in lines if line.startswith("SigCgt")).split()[1], 16)
    return bool(caught >> (signal.SIGTERM - 1) & 1)


def has_begun(pid: int) -> bool:
    """Whether it has loaded what does its work, or opened a socket."""
    mapped = Path(f"/proc/{pid}/maps").read_text()
    if any(name in mapped for name in ("numpy", "libgst", "zenoh")):
        return True
    files = (str(file.readlink()) for file in Path(f"/proc/{pid}/fd").iterdir())
    return any(file.startswith("socket:") for file in files)


def terminate(folder: Path, index: int) -> str:
    """Stops a process at its moment, looks at it, and terminates it; returns what was wrong."""
    settings = (
        f"link.port={free_port(socket.SOCK_DGRAM)}",
        "telemetry.connect=[]",
        'telemetry.listen=["tcp/127.0.0.1:0"]',
    )
    with PayloadProcess(folder, *SMALL, *settings) as payload:
        time.sleep(moment_s(index))
        payload.process.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, payload.pid, os.WSTOPPED)
        handles, begun = handles_sigterm(payload.pid), has_begun(payload.pid)
        payload.process.send_signal(signal.SIGTERM)
        ended = payload.end(signal.SIGCONT)
    where = f"SIGTERM {moment_s(index):.3f} s after the start: "
    if not handles:  # the interpreter itself is still loading
        if begun:
            return where + "it had begun its work without a handler for SIGTERM"
        return "" if ended.status == -signal.SIGTERM else where + f"status {ended.status}"
    try:
        ended.assert_in_order()
        counts = ended.counts
        if "payload blimp-1" in ended.out:  # it had been built: then it flew, however shortly
            assert counts and counts["captured"] - counts["gated"] == (
                counts["sent"] + counts["discarded"]
            ), ended.out
    except AssertionError as error:
        return f"{where}{error}"
    return ""


def replace(folder: Path, ground: Ground, index: int) -> str:
    """Kills a process at its moment and starts another on its ports; returns what was wrong."""
    settings = (
        *SMALL,
        f"link.port={ground.port}",
        f"telemetry.connect={json.dumps(ground.endpoints)}",
        f'telemetry.listen=["tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"]',
    )
    where = f"SIGKILL {moment_s(index):.3f} s after the start: "
    with PayloadProcess(folder / "killed", *settings) as killed:
        time.sleep(moment_s(index))
        killed.end(signal.SIGKILL)
    start_ns = time.time_ns()
    with PayloadProcess(folder / "next", *settings) as successor:
        fresh = ground.wait_for(lambda seen: seen.clock_ns > start_ns, FRESH_S)
        ended = successor.end()
    if fresh is None:
        return f"{where}the next one did not stream within {FRESH_S:g} s: {ended.err}"
    try:
        ended.assert_in_order()
    except AssertionError as error:
        return f"{where}the next one: {error}"
    return ""


def test_sigterm_ends_in_order_at_any_moment(tmp_path: Path) -> None:
    with ThreadPoolExecutor(WORKERS) as pool:
        wrong = list(pool.map(lambda i: terminate(tmp_path / str(i), i), range(TERMINATED)))
    assert not any(wrong), "\n".join(filter(None, wrong))


def test_after_sigkill_the_next_process_streams(tmp_path: Path) -> None:
    def some(worker: int) -> list[str]:
        with Ground(numbered=False) as ground:
            return [
                replace(tmp_path / str(index), ground, index)
                for index in range(worker, KILLED, WORKERS)
            ]

    with ThreadPoolExecutor(WORKERS) as pool:
        wrong = [line for lines in pool.map(some, range(WORKERS)) for line in lines]
    assert not any(wrong), "\n".join(filter(None, wrong))


def test_a_second_sigterm_changes_nothing(tmp_path: Path) -> None:
    settings = (*SMALL, "telemetry.enabled=false", f"link.port={free_port(socket.SOCK_DGRAM)}")
    with PayloadProcess(tmp_path, *settings) as payload:
        payload.wait_written("payload blimp-1")
        payload.process.send_signal(signal.SIGTERM)
        ended = payload.end(signal.SIGTERM)
    ended.assert_in_order()
    assert ended.took_s < STOP_S
