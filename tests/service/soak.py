"""A long run of the whole service with a payload that comes and goes, loss, and garbage.

    python tests/service/soak.py --minutes 60 --out out/service-soak.json

Prints a table and ends with status 1 when a bound is missed. pytest does not collect it.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import socket
import statistics
import sys
import tempfile
import threading
import time
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path

from intake_stand import ImpairedLink, Impairment, encoded, eventually, packets, stamped
from payload_process import Ended
from standing import Row, Service, Viewer, conclude

from ground_station.service import notes
from ground_station.service.bus import Bus
from ground_station.service.notes import EstimateNote, PayloadNote

NAME = "blimp-1"
SAMPLE_S = 10.0
GROWTH = 0.05
"""How much the memory of a process may grow after the first minutes."""
GARBAGE_HZ = 50.0
_SEED = 5
_ENDS = 6  # samples whose median is the beginning, and the end


class Heard:
    """The newest of what is said of the payload."""

    def __init__(self, bus: Bus) -> None:
        self.payload: PayloadNote | None = None
        self.estimate: EstimateNote | None = None
        self.states: Counter[str] = Counter()
        bus.hear(notes.PAYLOAD, PayloadNote, self._hear_payload, NAME)
        bus.hear(notes.ESTIMATE, EstimateNote, self._hear_estimate, NAME)

    def _hear_payload(self, _: str, note: PayloadNote) -> None:
        self.payload = note

    def _hear_estimate(self, _: str, note: EstimateNote) -> None:
        self.estimate = note
        self.states[note.state] += 1

    @property
    def told(self) -> Counter[str]:
        """What the localizer says that it processed and skipped, since its start."""
        note = self.estimate
        fates = ("processed", "localized", "skipped")
        return Counter({fate: getattr(note, fate) for fate in fates} if note else {})


@dataclass
class Flight:
    """One flight's account: the payload's own at its end, the intake's, the localizer's."""

    payload: dict[str, int]
    intake: dict[str, int]
    localizer: dict[str, int]
    in_order: bool


@dataclass
class Flown:
    """What was measured; memory as (s, MB) by process."""

    memory: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    flights: list[Flight] = field(default_factory=list)
    states: dict[str, int] = field(default_factory=dict)
    link: dict[str, int] = field(default_factory=dict)
    viewer: dict[str, int] = field(default_factory=dict)
    restarts: dict[str, int] = field(default_factory=dict)
    recordings: int = 0
    garbage: int = 0
    load: list[float] = field(default_factory=list)
    ended_s: float = 0.0
    written: str = ""


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


def fly(duration_s: float, flight_s: float, gap_s: float, loss: float) -> Flown:
    """The run: flights with pauses between them until the time is over."""
    flown = Flown()
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        service = stack.enter_context(
            Service(folder, "recording.at_start=true", f"recording.max_file_s={max(10, flight_s)}")
        )
        heard = Heard(stack.enter_context(service.bus()))
        link = stack.enter_context(ImpairedLink(service.video, Impairment(loss=loss), seed=_SEED))
        viewer = stack.enter_context(Viewer(service, NAME))
        garbage = stack.enter_context(Garbage(service.video))
        start_s = sampled_s = time.monotonic()

        def wait(seconds: float) -> None:
            nonlocal sampled_s
            until_s = time.monotonic() + seconds
            while (now_s := time.monotonic()) < until_s:
                time.sleep(max(0.0, min(0.2, until_s - now_s)))
                if now_s >= sampled_s + SAMPLE_S:
                    sampled_s += SAMPLE_S
                    sample(service, now_s - start_s, flown)

        while (now_s := time.monotonic()) < start_s + duration_s:
            before = heard.told
            with service.fly(NAME, folder / f"flight-{len(flown.flights)}", port=link.port) as one:
                wait(min(flight_s, max(20.0, start_s + duration_s - now_s)))
                ended = one.end()
            eventually(lambda: link.idle)
            flown.flights.append(account(heard, ended, before))
            print(f"{(time.monotonic() - start_s) / 60:5.1f} min {flown.flights[-1]}", flush=True)
            wait(gap_s)
        flown.restarts = {item["name"]: item["restarts"] for item in service.state()["processes"]}
        flown.states, flown.link = dict(heard.states), asdict(link.counts)
        flown.viewer = {**viewer.counts, "connections": viewer.connections}
        flown.garbage = garbage.sent
        flown.ended_s = service.end()
        flown.written = service.written()
        flown.recordings = len(list(service.recordings.glob("*.mcap")))
    return flown


def sample(service: Service, now_s: float, flown: Flown) -> None:
    """Memory of each process now."""
    named = dict(service.processes())
    for name, one in named.items():
        flown.memory.setdefault(name, []).append((now_s, one.memory_MB()))
    flown.memory.setdefault("station", []).append((now_s, memory_of_parent(service)))
    flown.load.append(os.getloadavg()[0])


def memory_of_parent(service: Service) -> float:
    """Resident memory of the parent."""
    pages = int(Path(f"/proc/{service.process.pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def account(heard: Heard, ended: Ended, before: Counter[str]) -> Flight:
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
    told.subtract(before)
    tidy = ended.status == 0 and "Traceback" not in ended.out + ended.err
    return Flight(counts, intake, dict(told), tidy)


def rows(flown: Flown, settled_s: float, loss: float) -> list[Row]:
    """The table."""
    return [
        *memory_rows(flown, settled_s),
        *account_rows(flown),
        Row("states of estimates", str(flown.states)),
        Row(
            "packets, lost of those that came",
            f"{flown.link['lost']} of {flown.link['received']}",
            f"{100 * loss:g} %",
            0.5 * loss <= flown.link["lost"] / flown.link["received"] <= 1.5 * loss,
        ),
        Row("garbage datagrams", str(flown.garbage)),
        Row("messages to a viewer", str(sum(flown.viewer.values()))),
        Row(
            "connections of that viewer",
            str(flown.viewer["connections"]),
            "1",
            flown.viewer["connections"] == 1,
        ),
        Row(
            "processes started anew",
            str(sum(flown.restarts.values())),
            "0",
            not any(flown.restarts.values()),
        ),
        Row("recordings", str(flown.recordings)),
        Row("from SIGTERM to the end", f"{flown.ended_s:.1f} s", "10 s", flown.ended_s < 10),
        Row("load average", f"{min(flown.load):.1f} to {max(flown.load):.1f}"),
    ]


def memory_rows(flown: Flown, settled_s: float) -> list[Row]:
    """How the memory of each process grew after the first minutes."""
    result = []
    for name, points in sorted(flown.memory.items()):
        settled = [size for at_s, size in points if at_s >= settled_s]
        if len(settled) < 2 * _ENDS:
            result.append(Row(f"memory, {name}", f"{len(settled)} samples", "enough", False))
            continue
        first, last = statistics.median(settled[:_ENDS]), statistics.median(settled[-_ENDS:])
        grown, most = last / first - 1, max(settled) / first - 1
        text = f"{first:.1f} to {last:.1f} MB, {100 * grown:+.1f} % (most {100 * most:+.1f})"
        result.append(Row(f"memory, {name}", text, f"{100 * GROWTH:g} %", grown < GROWTH))
    return result


def account_rows(flown: Flown) -> list[Row]:
    """All flights together, exact for each: what was sent, what came, and what became of it."""
    total: dict[str, Counter[str]] = {"payload": Counter(), "intake": Counter(), "own": Counter()}
    off_sent = off_received = not_taken = 0
    for number, flight in enumerate(flown.flights):
        total["payload"].update(flight.payload)
        total["intake"].update(flight.intake)
        total["own"].update(flight.localizer)
        intake, own = flight.intake, flight.localizer
        arrived = intake.get("received", 0) + intake.get("withheld", 0) + intake.get("lost", 0)
        off_sent += flight.payload.get("sent", -1) != arrived
        behind = intake.get("received", 0) - own.get("processed", 0) - own.get("skipped", 0)
        if number == 0:
            not_taken = behind  # before its localizer was up
        off_received += behind != 0 and (number > 0 or behind < 0)
    payload, intake, own = total["payload"], total["intake"], total["own"]
    encoded_ = payload["captured"] - payload["gated"]
    flights = len(flown.flights)
    return [
        Row(
            "flights, ended in order",
            f"{sum(flight.in_order for flight in flown.flights)} of {flights}",
            "all",
            all(flight.in_order for flight in flown.flights),
        ),
        Row(
            "captured − gated = sent + discarded",
            f"{encoded_} = {payload['sent']} + {payload['discarded']}",
            "exact",
            encoded_ == payload["sent"] + payload["discarded"],
        ),
        Row(
            "sent = received + withheld + lost",
            f"{payload['sent']} = {intake['received']} + {intake['withheld']} + {intake['lost']}",
            f"exact in all {flights}",
            off_sent == 0,
        ),
        Row(
            "received = processed + skipped",
            f"{intake['received']} = {own['processed']} + {own['skipped']} + {not_taken}",
            f"exact in all {flights}",
            off_received == 0,
        ),
        Row("  of these before the localizer", str(not_taken)),
        Row("localized, of those processed", f"{own['localized']} of {own['processed']}"),
    ]


def main() -> int:
    """Runs, prints, writes; 1 when a bound is missed."""
    parser = argparse.ArgumentParser(description="A long run of the whole service.")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--settled", type=float, default=10.0, help="minutes memory may grow in")
    parser.add_argument("--flight-s", type=float, default=110.0)
    parser.add_argument("--gap-s", type=float, default=10.0)
    parser.add_argument("--loss", type=float, default=0.02, help="share of packets, 0 to 1")
    parser.add_argument("--out", type=Path, metavar="FILE", help="the figures as JSON")
    arguments = parser.parse_args()
    if not (arguments.settled + 2 * _ENDS * SAMPLE_S / 60 < arguments.minutes <= 10_000):
        parser.error("--minutes: beyond --settled by more than 2, at most 10000")
    if not (0 < arguments.loss < 1 and arguments.flight_s >= 20 and 0 <= arguments.gap_s < 50):
        parser.error("--loss: 0 to 1; --flight-s: from 20; --gap-s: 0 to 50")
    flown = fly(60 * arguments.minutes, arguments.flight_s, arguments.gap_s, arguments.loss)
    table = rows(flown, 60 * arguments.settled, arguments.loss)
    print(f"\n{arguments.minutes:g} minutes, {100 * arguments.loss:g} % loss")
    return conclude(table, asdict(flown), arguments.out)


if __name__ == "__main__":
    sys.exit(main())
