"""How long from capture to pose, and to the screen, while viewers take all that a dashboard takes.

    python tests/service/latency.py --seconds 60 --browser --out out/latency.json

Prints a table and ends with status 1 when a bound is missed. pytest does not collect it.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from intake_stand import eventually
from soaking.report import conclude
from soaking.table import Row
from standing import Estimates, Process, Service, Viewer, process

VIEWERS = 2
MEDIAN_MS, P99_MS = 60.0, 150.0
FAIR = 0.9
SETTLE_S = 5.0
"""From when all are tracked to the first frame that counts."""
TRACKING_S = 90.0
LOAD_S = 5.0


@dataclass
class Measured:
    """Latencies in ms by payload, and of pictures on the screen; the rest over the same time."""

    seconds: float
    pose_ms: dict[str, list[float]] = field(default_factory=dict)
    screen_ms: list[float] = field(default_factory=list)
    states: dict[str, dict[str, int]] = field(default_factory=dict)
    fates: dict[str, dict[str, int]] = field(default_factory=dict)
    cpu: dict[str, float] = field(default_factory=dict)
    memory_MB: dict[str, float] = field(default_factory=dict)
    viewers: dict[str, int] = field(default_factory=dict)
    load: list[float] = field(default_factory=list)


@contextlib.contextmanager
def dashboard(url: str) -> Iterator[Callable[[float], list[float]]]:
    """Chromium on the page; gives a wait of some seconds, in which its reports come, in ms."""
    sys.path.append(str(Path(__file__).parents[1]))
    from browsing import ARGUMENTS
    from playwright.sync_api import sync_playwright

    path = shutil.which("chromium") or "/usr/bin/chromium"
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=list(ARGUMENTS))
        page = browser.new_page(viewport={"width": 1440, "height": 900})
        shown: list[float] = []

        def sent(text: str | bytes) -> None:
            message = json.loads(text)
            if message.get("type") == "shown":
                shown.append(float(message["shown_ms"]))

        page.on("websocket", lambda socket: socket.on("framesent", sent))
        page.goto(url)

        def wait(seconds: float) -> list[float]:
            shown.clear()
            page.wait_for_timeout(1000 * seconds)
            return list(shown)

        yield wait
        browser.close()


def measure(seconds: float, payloads: int, rate_hz: float, *, browser: bool) -> Measured:
    """The service with so many payloads, two viewers, and a browser beside if wanted."""
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        names = [f"blimp-{number + 1}" for number in range(payloads)]
        service = stack.enter_context(Service(folder, payloads=names))
        flying: list[Process | None] = []
        for name in names:
            one = stack.enter_context(service.fly(name, folder / name, rate_hz=rate_hz))
            flying.append(process(f"payload {name}", one.pid))
        eventually(lambda: all(service.tracking(name) for name in names), TRACKING_S)
        viewers = [
            stack.enter_context(Viewer(service, names[number % payloads]))
            for number in range(VIEWERS)
        ]
        wait = stack.enter_context(dashboard(service.url)) if browser else _wait
        wait(SETTLE_S)
        watched = [*service.processes().values(), *filter(None, flying)]
        watched += filter(None, [process("station", service.process.pid)])
        result = Measured(seconds)
        before = {one: one.cpu_s() for one in watched}
        browser_s = _browser_s()
        taken = [dict(viewer.counts) for viewer in viewers]
        fates = {name: _fates(service, name) for name in names}
        # On its own bus: the dashboard's channel may leave estimates out, this must not.
        estimates = Estimates(stack.enter_context(service.bus()))
        start_s = time.monotonic()
        while (left_s := start_s + seconds - time.monotonic()) > 0:
            result.screen_ms += wait(min(LOAD_S, left_s))
            result.load.append(os.getloadavg()[0])
        result.seconds = time.monotonic() - start_s
        result.pose_ms = {name: list(values) for name, values in estimates.latency_ms.items()}
        result.states = {name: dict(counts) for name, counts in estimates.states.items()}
        for one in watched:
            result.cpu[one.name] = (one.cpu_s() - before[one]) / result.seconds
            result.memory_MB[one.name] = one.memory_MB()
        if browser:
            result.cpu["Chromium, without a GPU"] = (_browser_s() - browser_s) / result.seconds
        for viewer, counts in zip(viewers, taken, strict=True):
            for kind, count in viewer.counts.items():
                more = count - counts.get(kind, 0)
                result.viewers[kind] = result.viewers.get(kind, 0) + more
        for name in names:
            now = _fates(service, name)
            result.fates[name] = {fate: now[fate] - fates[name][fate] for fate in now}
        assert set(service.processes().values()) <= set(watched), "a process was restarted"
    return result


def _wait(seconds: float) -> list[float]:
    time.sleep(seconds)
    return []


def _browser_s() -> float:
    """Processor time that all of Chromium's processes under this one used so far."""
    found, used_s = [os.getpid()], 0.0
    for pid in found:  # grows while it is read
        with contextlib.suppress(OSError):
            for task in Path(f"/proc/{pid}/task").iterdir():
                found += [int(child) for child in (task / "children").read_text().split()]
            one = process("", pid)
            if one and b"chrom" in Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")[0]:
                used_s += one.cpu_s()
    return used_s


def _fates(service: Service, payload_id: str) -> dict[str, int]:
    view = service.payload(payload_id)
    frames, estimate = view["payload"]["frames"], view["estimate"]
    return {
        **{fate: frames.get(fate, 0) for fate in ("sent", "received", "lost", "withheld")},
        **{fate: estimate[fate] for fate in ("processed", "localized", "skipped")},
    }


def rows(measured: Measured, rate_hz: float, *, bounded: bool) -> list[Row]:
    """The table; with a browser or another payload on the same cores latencies are only told.

    Of several payloads at one rate none starves: it gets no fewer poses than another.
    """
    result = []
    poses = [len(values) for values in measured.pose_ms.values()]
    if len(poses) > 1:
        share = min(poses) / max(1, *poses)
        result.append(Row("fewest poses of the most", f"{share:.2f}", f"{FAIR:g}", share >= FAIR))
    for name, values in sorted(measured.pose_ms.items()):
        result += latency_rows(f"capture to pose, {name}", values, bounded=bounded)
        rate = len(values) / measured.seconds
        result.append(Row(f"poses, {name}", f"{len(values)}, {rate:.1f} Hz of {rate_hz:g}"))
        result.append(Row("  states", str(measured.states[name])))
        result.append(Row("  frames", json.dumps(measured.fates[name]).replace('"', "")))
    if measured.screen_ms:
        result += latency_rows("capture to screen", measured.screen_ms, bounded=False)
        rate = len(measured.screen_ms) / measured.seconds
        result.append(Row("pictures on the screen", f"{rate:.1f} Hz"))
    video = measured.viewers.get("video", 0) / measured.seconds / VIEWERS
    told = measured.viewers.get("estimate", 0) / measured.seconds / VIEWERS
    result.append(Row("to each of two viewers", f"{video:.1f} pictures, {told:.1f} estimates /s"))
    for name, share in measured.cpu.items():
        size = f", {measured.memory_MB[name]:.0f} MB" if name in measured.memory_MB else ""
        result.append(Row(name, f"{100 * share:.0f} % of a core{size}"))
    result.append(Row("all together", f"{100 * sum(measured.cpu.values()):.0f} % of a core"))
    load = measured.load
    text = f"{min(load):.1f} to {max(load):.1f} on {os.cpu_count()} cores"
    return [*result, Row("load average (1 min)", text)]


def latency_rows(name: str, values: list[float], *, bounded: bool) -> list[Row]:
    """Median, p99 and the longest, in ms."""
    if not values:
        return [Row(name, "none", "some", False)]
    median, p99, longest = np.quantile(values, (0.5, 0.99, 1.0))
    bounds = (f"{MEDIAN_MS:g} ms", f"{P99_MS:g} ms") if bounded else ("", "")
    return [
        Row(f"{name}, median", f"{median:.1f} ms", bounds[0], bool(median <= MEDIAN_MS)),
        Row(f"{name}, p99", f"{p99:.1f} ms", bounds[1], bool(p99 <= P99_MS)),
        Row(f"{name}, longest", f"{longest:.1f} ms"),
    ]


def main() -> int:
    """Measures, prints, writes; 1 when a bound is missed."""
    parser = argparse.ArgumentParser(description="From capture to pose, and to the screen.")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--browser", action="store_true", help="a headless Chromium beside")
    parser.add_argument("--payloads", type=int, default=1)
    parser.add_argument("--rate-hz", type=float, default=30.0)
    parser.add_argument("--out", type=Path, metavar="FILE", help="the figures as JSON")
    arguments = parser.parse_args()
    if not (1 <= arguments.seconds <= 86_400 and 1 <= arguments.payloads <= 4):
        parser.error("--seconds: 1 to 86400; --payloads: 1 to 4")
    if not 1 <= arguments.rate_hz <= 30:
        parser.error("--rate-hz: 1 to 30")
    measured = measure(
        arguments.seconds, arguments.payloads, arguments.rate_hz, browser=arguments.browser
    )
    bounded = not arguments.browser and arguments.payloads == 1
    table = rows(measured, arguments.rate_hz, bounded=bounded)
    beside = " and Chromium" if arguments.browser else ""
    print(
        f"{measured.seconds:.0f} s, {arguments.payloads} payload(s) at {arguments.rate_hz:g} Hz,"
        f" two viewers{beside}"
    )
    return conclude(table, (), 0.0, asdict(measured), arguments.out)


if __name__ == "__main__":
    sys.exit(main())
