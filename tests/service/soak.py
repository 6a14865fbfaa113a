"""A long run of the whole service with a payload that comes and goes, loss, and garbage.

    python tests/service/soak.py --hours 1 --out out/soak-service.json

Prints a table, draws out/soak-service.png and ends with status 1 when a bound is missed. Ctrl-C
ends the run in order and judges what was measured. pytest does not collect it.
"""

from __future__ import annotations

import contextlib
import os
import random
import socket
import sys
import tempfile
import threading
import time
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import httpx
from intake_stand import ImpairedLink, Impairment, encoded, eventually, packets, stamped
from payload_process import Ended
from service_account import Flight, account_rows
from soaking import report
from soaking.arguments import MOST_HOURS, Parser, number, on_interrupt
from soaking.judging import rows as slope_rows
from soaking.measures import CLOCK, LATENCY, MEMORY, Measure, Window, Windows
from soaking.processes import Watch
from soaking.table import Row
from standing import Service, Viewer

from ground_station.errors import GroundStationError
from ground_station.service import bus_messages
from ground_station.service.bus import Bus
from ground_station.service.bus_messages import EstimateMessage, PayloadMessage

NAME = "blimp-1"
STATION, PAYLOAD = "station", "payload"
SAMPLE_S = 10.0
KEEP_S = 300.0
"""How often what was measured is written meanwhile: what a lost supply costs."""
SETTLED_S = 600.0
"""Until then buffers, caches and pools may grow; of a short run a sixth."""
GROWTH = 0.05
"""How much the memory of a process may grow after that."""
# What would matter, an hour. A ground station of 8 GB and 1,024 descriptors a process that stays on
# for a week: 1.7 GB in each process, and 700 descriptors. (Of a slow counter an hour tells no less
# than 4 an hour from 0.) A flight's payload is another process each time: drawn, and not judged.
MEMORY_MB, FILES = 10.0, 4.0
PROCESSES = (STATION, "intake", "web", "foxglove", f"localizer/{NAME}")
MEDIAN_MS, P99_MS, CLOCK_MS = 10.0, 100.0, 1.0
GARBAGE_HZ = 50.0
_SEED = 5


class Heard:
    """The newest of what is said of the payload, and how long each pose took."""

    def __init__(self, bus: Bus) -> None:
        self.payload: PayloadMessage | None = None
        self.estimate: EstimateMessage | None = None
        self.states: Counter[str] = Counter()
        self.latency_ms: deque[tuple[float, float]] = deque()
        """(monotonic s, ms from capture to pose), until somebody takes it."""
        bus.subscribe(bus_messages.PAYLOAD, PayloadMessage, self._hear_payload, NAME)
        bus.subscribe(bus_messages.ESTIMATE, EstimateMessage, self._hear_estimate, NAME)

    def _hear_payload(self, _: str, note: PayloadMessage) -> None:
        self.payload = note

    def _hear_estimate(self, _: str, note: EstimateMessage) -> None:
        self.estimate = note
        self.states[note.state] += 1
        if note.capture_ns is not None and note.position_m is not None:
            self.latency_ms.append((time.monotonic(), 1e-6 * (note.done_ns - note.capture_ns)))

    @property
    def clock_ms(self) -> float | None:
        """The payload's clock against this machine's; None while it is not known."""
        note = self.payload
        if note is None or not note.alive or not note.clock:
            return None
        return 1e-6 * note.clock["offset_ns"]

    @property
    def told(self) -> Counter[str]:
        """What the localizer says that it processed and skipped of this flight."""
        note = self.estimate
        fates = ("processed", "localized", "skipped")
        return Counter({fate: getattr(note, fate) for fate in fates} if note else {})


@dataclass
class Flown:
    """What was measured."""

    watch: Watch = field(
        default_factory=lambda: Watch(dict.fromkeys(PROCESSES, (MEMORY_MB, FILES)))
    )
    median: Measure = field(default_factory=lambda: Measure(LATENCY, "median", "ms", MEDIAN_MS))
    p99: Measure = field(default_factory=lambda: Measure(LATENCY, "p99", "ms", P99_MS))
    clock: Measure = field(
        default_factory=lambda: Measure(CLOCK, "payload's offset", "ms", CLOCK_MS, both=True)
    )
    flights: list[Flight] = field(default_factory=list)
    states: dict[str, int] = field(default_factory=dict)
    link: dict[str, int] = field(default_factory=dict)
    viewer: dict[str, int] = field(default_factory=dict)
    restarts: dict[str, int] = field(default_factory=dict)
    recordings: int = 0
    garbage: int = 0
    load: list[float] = field(default_factory=list)
    ended_s: float = 0.0
    flown_s: float = 0.0
    written: str = ""

    @property
    def measures(self) -> list[Measure]:
        """All that is drawn and judged."""
        return [*self.watch.measures, self.median, self.p99, self.clock]

    def add_latency(self, window: Window | None) -> None:
        """A window of latencies that has ended."""
        if window is not None:
            self.median.add(window.at_s, window.median)
            self.p99.add(window.at_s, window.p99)


class Garbage:
    """Datagrams that are no RTP, halves of it, and a stranger's video, for ever."""

    def __init__(self, port: int) -> None:
        self.sent = 0
        self._to = ("127.0.0.1", port)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="garbage", daemon=True)
        units = [stamped(unit, k) for k, unit in enumerate(encoded(30))]
        self._stranger = packets(units, ssrc=4711)

    def __enter__(self) -> Garbage:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        self._thread.join()

    def _run(self) -> None:
        draw = random.Random(_SEED)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            while not self._closing.wait(1.0 / GARBAGE_HZ):
                whole = draw.choice(self._stranger)
                kinds = (draw.randbytes(draw.randint(0, 1400)), whole, whole[: draw.randint(0, 40)])
                out.sendto(draw.choice(kinds), self._to)
                self.sent += 1


class Sampler:
    """Takes a sample each ten seconds while it waits, and writes what there is now and then."""

    def __init__(self, service: Service, heard: Heard, flown: Flown, options: Any) -> None:
        self._service, self._heard, self._flown, self._options = service, heard, flown, options
        self._windows = Windows(SAMPLE_S)
        self._start_s = self._sampled_s = self._kept_s = time.monotonic()
        self.payload: int | None = None
        """The process of the payload that flies now."""

    @property
    def passed_s(self) -> float:
        """Since the start."""
        return time.monotonic() - self._start_s

    def wait(self, seconds: float, interrupted: threading.Event) -> None:
        """Samples meanwhile; ends early when interrupted."""
        until_s = time.monotonic() + seconds
        while (now_s := time.monotonic()) < until_s and not interrupted.is_set():
            interrupted.wait(max(0.0, min(0.2, until_s - now_s)))
            if now_s >= self._sampled_s + SAMPLE_S:
                self._sampled_s += SAMPLE_S
                self._sample(now_s - self._start_s)
            if self._options.out is not None and now_s >= self._kept_s + KEEP_S:
                self._kept_s = now_s
                keep(self._flown, self._options)

    def _sample(self, at_s: float) -> None:
        pids = {name: one.pid for name, one in self._service.processes().items()}
        pids[STATION] = self._service.process.pid
        if self.payload is not None:
            pids[PAYLOAD] = self.payload
        self._flown.watch.sample(at_s, pids)
        self._flown.clock.add(at_s, self._heard.clock_ms)
        self._flown.load.append(os.getloadavg()[0])
        latency_ms = self._heard.latency_ms
        while latency_ms:
            then_s, value = latency_ms.popleft()
            self._flown.add_latency(self._windows.add(then_s - self._start_s, value))


def fly(options: Any, flown: Flown, interrupted: threading.Event) -> None:
    """The run: flights with pauses between them until the time is over."""
    duration_s, flight_s = 3600.0 * options.hours, options.flight_s
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        longest = f"recording.max_file_s={max(10, flight_s)}"
        service = stack.enter_context(Service(folder, "recording.at_start=true", longest))
        heard = Heard(stack.enter_context(service.bus()))
        impairment = Impairment(loss=options.loss)
        link = stack.enter_context(ImpairedLink(service.video, impairment, seed=_SEED))
        viewer = stack.enter_context(Viewer(service, NAME))
        garbage = stack.enter_context(Garbage(service.video))
        sampler = Sampler(service, heard, flown, options)
        while sampler.passed_s < duration_s and not interrupted.is_set():
            number_ = len(flown.flights)
            with service.fly(NAME, folder / f"flight-{number_}", port=link.port) as one:
                sampler.payload = one.pid
                sampler.wait(min(flight_s, max(20.0, duration_s - sampler.passed_s)), interrupted)
                sampler.payload = None
                ended = one.end()
            eventually(lambda: link.idle)
            if not interrupted.is_set():  # the whole service ends with a Ctrl-C, with its accounts
                flown.flights.append(account(heard, ended))
                print(f"{sampler.passed_s / 60:5.1f} min {flown.flights[-1]}", flush=True)
                sampler.wait(options.gap_s, interrupted)
        flown.flown_s = sampler.passed_s
        with contextlib.suppress(httpx.HTTPError):  # it has ended with a Ctrl-C, too
            flown.restarts = {one["name"]: one["restarts"] for one in service.state()["processes"]}
        flown.states, flown.link = dict(heard.states), asdict(link.counts)
        flown.viewer = {**viewer.counts, "connections": viewer.connections}
        flown.garbage = garbage.sent
        flown.ended_s = service.end()
        flown.written = service.written()
        flown.recordings = len(list(service.recordings.glob("*.mcap")))


def account(heard: Heard, ended: Ended) -> Flight:
    """The three accounts of a flight that has ended, once none of them changes any more."""
    counts = ended.counts

    def settled() -> bool:
        note = heard.payload
        fits = note is not None and not note.alive
        return fits and all(note.frames.get(name) == value for name, value in counts.items())

    with contextlib.suppress(AssertionError):  # the table shows what did not fit
        eventually(settled, 20.0)
    last = None
    while last != (last := heard.told):
        time.sleep(1.0)
    intake = dict(heard.payload.frames) if heard.payload else {}
    told = heard.told
    tidy = ended.status == 0 and "Traceback" not in ended.out + ended.err
    return Flight(counts, intake, dict(told), tidy)


def settled_s(options: Any) -> float:
    """From when slopes are judged."""
    return min(SETTLED_S, 600.0 * options.hours)


def rows(flown: Flown, options: Any) -> list[Row]:
    """The table."""
    lost, received = flown.link.get("lost", 0), flown.link.get("received", 0)
    share = lost / received if received else 0.0
    connections = flown.viewer.get("connections", 0)
    return [
        *growth_rows(flown.measures, settled_s(options)),
        *slope_rows(flown.measures, settled_s(options)),
        *account_rows(flown.flights),
        Row("states of estimates", str(flown.states)),
        Row(
            "packets, lost of those that came",
            f"{lost} of {received}",
            f"{100 * options.loss:g} %",
            0.5 * options.loss <= share <= 1.5 * options.loss,
        ),
        Row("garbage datagrams", str(flown.garbage)),
        Row("messages to a viewer", str(sum(flown.viewer.values()))),
        Row("connections of that viewer", str(connections), "1", connections == 1),
        Row(
            "processes restarted",
            str(sum(flown.restarts.values()) + changed(flown.watch)),
            "0",
            bool(flown.restarts) and not any(flown.restarts.values()) and not changed(flown.watch),
        ),
        Row("recordings", str(flown.recordings)),
        Row("from SIGTERM to the end", f"{flown.ended_s:.1f} s", "10 s", flown.ended_s < 10),
        Row("load average", span(flown.load)),
    ]


def span(values: Sequence[float]) -> str:
    """Least to most."""
    return f"{min(values, default=0.0):.1f} to {max(values, default=0.0):.1f}"


def changed(watch: Watch) -> int:
    """How often another process was seen under a name of the service's own."""
    return sum(count for name, count in watch.changed.items() if name != PAYLOAD)


def growth_rows(measures: Sequence[Measure], from_s: float) -> list[Row]:
    """How the memory of each process grew after the first minutes, from its trend."""
    result = []
    for measure in measures:
        if measure.kind == MEMORY and measure.matters is not None:
            values = measure.settled(from_s)[:, 1]
            if len(values) < 12:
                few = f"{len(values)} samples"
                result.append(Row(f"memory, {measure.name}", few, "enough", False))
                continue
            part = max(6, len(values) // 10)
            first, last = sorted(values[:part])[part // 2], sorted(values[-part:])[part // 2]
            grown, most = last / first - 1, values.max() / first - 1
            text = f"{first:.1f} to {last:.1f} MB, {100 * grown:+.1f} % (most {100 * most:+.1f})"
            bound = f"{100 * GROWTH:g} %"
            result.append(Row(f"memory, {measure.name}", text, bound, bool(grown < GROWTH)))
    return result


def about(flown: Flown, options: Any) -> dict[str, Any]:
    """What the figures are of."""
    return {
        "title": f"Soak: the whole service, {options.hours:g} h, flights of {options.flight_s:g} s,"
        f" {100 * options.loss:g} % loss; simulated flight",
        "hours": options.hours,
        "flown_h": flown.flown_s / 3600.0,
        "loss": options.loss,
        "flights": [asdict(flight) for flight in flown.flights],
        "states": flown.states,
        "link": flown.link,
        "viewer": flown.viewer,
        "restarts": flown.restarts,
        "changed": flown.watch.changed,
        "load": flown.load,
        "written": flown.written,
    }


def keep(flown: Flown, options: Any) -> None:
    """Writes what there is."""
    report.write(options.out, flown.measures, settled_s(options), about(flown, options))


def parser() -> Parser:
    """The command line."""
    result = Parser(prog="soak", description="A long run of the whole service.")
    result.add_argument("--hours", type=number(0.05, MOST_HOURS), default=1.0, metavar="H")
    result.add_argument("--flight-s", type=number(20, 3600), default=110.0, metavar="S")
    result.add_argument("--gap-s", type=number(0, 50), default=10.0, metavar="S")
    result.add_argument("--loss", type=number(0.0001, 0.9), default=0.02, help="share of packets")
    result.add_argument("--out", type=Path, metavar="FILE", help="figures as JSON; a PNG beside")
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs, prints, writes, draws; 1 when a bound is missed, 2 for bad input."""
    options, flown = parser().parse_args(arguments), Flown()
    try:
        fly(options, flown, on_interrupt())
        table = rows(flown, options)
        print(f"\n{flown.flown_s / 3600:.3g} of {options.hours:g} hours")
        settled, told = settled_s(options), about(flown, options)
        return report.conclude(table, flown.measures, settled, told, options.out)
    except GroundStationError as error:
        print(f"soak: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
