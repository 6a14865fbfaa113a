"""Which of the invariants held in a flight that has ended."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from scenarios import accounts
from scenarios.camera import Truth
from scenarios.heard import Heard, Told
from scenarios.payload_run import PayloadRun
from scenarios.recordings import Came, lacking, read
from scenarios.world import NAME, World

TRACKING = "TRACKING"
OFF_M = 0.5
"""No pose called TRACKING is farther from the truth."""
_ON_ITS_WAY = 5
"""Frames that had left and not come when an intake was killed."""
MOST_MB = {
    "payload": 200.0,
    "station": 60.0,
    "intake": 180.0,
    "localizer": 420.0,
    "web": 150.0,
    "foxglove": 170.0,
}
"""Resident memory that no process exceeds, whatever others send: what `deploy/README.md` says.

The most in matrix and walks was 179, 38, 134, 334, 114 and 131 MB.
"""
INVARIANTS = ("accounts", "poses", "recordings", "recovery", "memory", "order")


@dataclass
class Verdict:
    """What was found wrong, by invariant, and what was measured."""

    name: str
    broken: dict[str, list[str]] = field(default_factory=lambda: {n: [] for n in INVARIANTS})
    figures: dict[str, Any] = field(default_factory=dict)
    injected: list[str] = field(default_factory=list)
    said: list[str] = field(default_factory=list)

    def share(self, flight: Verdict) -> None:
        """Takes over what was found of the flight as a whole; the recovery stays its own."""
        for invariant, texts in flight.broken.items():
            if invariant != "recovery":
                self.broken[invariant] += texts
        self.figures = flight.figures | self.figures

    @property
    def holds(self) -> bool:
        """Whether all did."""
        return not any(self.broken.values())


def judge(verdict: Verdict, world: World) -> None:
    """Adds what the flight's records say to a verdict that has its recovery already."""
    broken, heard = verdict.broken, world.heard
    broken["accounts"] += frames_accounted(world)
    off_m, wrong = poses(heard.estimates(), {run.ssrc: run.camera.truth for run in world.runs})
    broken["poses"] += wrong
    broken["recordings"] += recorded(world)
    broken["order"] += world.complaints + in_order(world)
    broken["memory"] += [
        f"{name}: {peak_MB:.0f} MB, allowed {MOST_MB[name]:g}"
        for name, peak_MB in world.peaks_MB.items()
        if peak_MB > MOST_MB[name]
    ]
    states = Counter(told.note.state for told in heard.estimates())
    verdict.figures |= {
        "frames": sum(len(frames) for frames in heard.shown.values()),
        "estimates": dict(states),
        "off_m": round(off_m, 3),
        "payloads": len(world.runs),
        "peaks_MB": {name: round(peak_MB, 1) for name, peak_MB in world.peaks_MB.items()},
        "services": world.service_runs,
        "recordings": len(list(world.service.recordings.glob("*.mcap"))),
        "link": vars(world.link.counts),
    }
    verdict.said = list(world.said)


def frames_accounted(world: World) -> list[str]:
    """Invariant 1 of every payload process, of the intake and of every localizer process."""
    complaints: list[str] = []
    heard = world.heard
    for run, later in zip(world.runs, [*world.runs[1:], None], strict=True):
        complaints += _of_run(run, later.began_s if later is not None else math.inf, heard)
    last = world.runs[-1]
    counts = last.ended.counts if last.ended is not None else {}
    note = heard.payload(NAME)
    if note is None or not counts:
        complaints.append("intake: it told nothing of the payload")
    else:
        complaints += accounts.of_intake(note.frames, counts["sent"], _before_intake(world, last))
        frames = [one for one in heard.frames(NAME) if one.key[0] == last.ssrc]
        if frames and _one_intake(world, last):
            received = note.frames.get("received", 0), note.frames.get("dropped", 0)
            complaints += accounts.of_received(len(frames), *received)
    for payload_id in heard.shown:
        taken = [
            (told.run, told.at, told.note.processed + told.note.skipped)
            for told in heard.estimates()
            if told.payload_id == payload_id and told.at >= 0
        ]
        for one in accounts.by_process(taken):
            complaints += accounts.of_localizer(one)
    return complaints


def _one_intake(world: World, run: PayloadRun) -> bool:
    """Whether the same intake took all of a payload's last stream."""
    return not any(run.began_s < at_s for at_s in world.intake_anew_s)


def _before_intake(world: World, run: PayloadRun) -> tuple[int, int]:
    """How many frames of a stream had left before the newest intake began: at least, at most."""
    anew_s = max(world.intake_anew_s, default=0.0)
    if anew_s < run.began_s:
        return 0, 0
    sent_before = sum(at_s < anew_s for at_s in run.watch.at_s)
    # Those that it has shown came after all of its own that it could not show.
    shown = {f.key[1] for f in world.heard.frames(NAME) if f.key[0] == run.ssrc and f.at_s > anew_s}
    first = (n for n, frame in enumerate(run.watch.left()) if frame.sequence in shown)
    return sent_before - _ON_ITS_WAY, next(first, len(run.watch.left()))


def _of_run(run: PayloadRun, until_s: float, heard: Heard) -> list[str]:
    complaints: list[str] = []
    if run.killed or run.unborn:
        said = [
            note.frames
            for who, note, at_s in heard.payloads
            if who == NAME and note.ssrc == run.ssrc and run.began_s < at_s < run.ended_s
        ]
        complaints += accounts.of_killed_payload(said[-1] if said else {})
    elif run.ended is not None:
        complaints += accounts.of_payload(run.ended.counts)
        if run.ended.counts:
            left = len(run.watch.left())
            complaints += accounts.of_link(run.ended.counts["sent"], left, run.watch.gaps)
    if run.ssrc in run.watch.ssrcs():
        shown = [
            frame
            for frames in heard.shown.values()
            for frame in frames
            if frame.key[0] == run.ssrc and run.began_s < frame.at_s < until_s
        ]
        complaints += accounts.of_shown(
            [frame.key[1] for frame in shown],
            [frame.key[1] for frame in shown if frame.damaged],
            run.watch.showable(run.ssrc),
            f"stream {run.ssrc}",
        )
    return complaints


def poses(told: list[Told], truths: dict[int, Truth | None]) -> tuple[float, list[str]]:
    """The farthest that a TRACKING pose was off, m, and those beyond `OFF_M` (invariant 2).

    `truths` are of the streams by SSRC; of a stream without one, and of a stranger's, no pose at
    all may be called TRACKING.
    """
    farthest_m, wrong = 0.0, []
    for one in told:
        note = one.note
        if note.state != TRACKING:
            continue
        truth = truths.get(one.ssrc)
        where = f"{one.payload_id}, frame {note.sequence}"
        if truth is None or note.position_m is None:
            wrong.append(f"{where}: TRACKING where there is nothing of the map")
            continue
        off_m = float(np.linalg.norm(np.array(note.position_m) - truth.at(note.time_ns)))
        farthest_m = max(farthest_m, off_m)
        if not off_m <= OFF_M:
            wrong.append(f"{where}: TRACKING {off_m:.2f} m off")
    if len(wrong) > 3:
        wrong = [*wrong[:3], f"and {len(wrong) - 3} more"]
    return farthest_m, wrong


def recorded(world: World) -> list[str]:
    """Invariant 3 of the ground's recordings, and of the payload's by each of its processes."""
    complaints: list[str] = []
    came = sorted(
        (
            Came(frame.key[1:], frame.at_s)
            for frames in world.heard.shown.values()
            for frame in frames
            if not frame.damaged  # recordings hold whole frames only
        ),
        key=lambda one: one.at_s,
    )
    ground = [read(path) for path in recordings_in(world.service.recordings)]
    if not any(file.frames for file in ground):
        complaints.append("ground: nothing was recorded")
    complaints += [f"ground: {text}" for text in lacking(ground, came, world.ended_s["ground"])]
    if world.heard.recording:
        note, _ = world.heard.recording[-1]
        if not (note.active or note.problem):
            complaints.append("ground: it does not record and says no problem")
    complaints += on_card(world)
    return complaints


def on_card(world: World) -> list[str]:
    """The payload's own recordings: what left each of its processes is in their files."""
    complaints: list[str] = []
    files = {path.name: read(path) for path in recordings_in(world.card)}
    for run, later in zip(world.runs, [*world.runs[1:], None], strict=True):
        until = set(later.card) if later is not None else set(files)
        own = [files[name] for name in sorted(until - set(run.card)) if name in files]
        clocks = {frame[0]: frame for file in own for frame in file.frames}
        left = [
            Came(clocks.get(frame.sequence, (frame.sequence, -1)), at_s)
            for frame, at_s in zip(run.watch.left(), run.watch.at_s, strict=False)
        ]
        ends = [*world.ended_s["card"], [run.ended_s, run.ended_s]]
        complaints += [f"card: {text}" for text in lacking(own, left, ends)]
    return complaints


def recordings_in(folder: Path) -> list[Path]:
    """By their numbers."""
    return sorted(folder.glob("*.mcap"), key=lambda path: (len(path.name), path.name))


def in_order(world: World) -> list[str]:
    """Invariant 5, of what was not seen on the way: accidents that some process wrote of."""
    complaints: list[str] = []
    for run in world.runs:
        if run.ended is None:
            complaints.append("a payload was left running")
            continue
        try:
            run.ended.assert_no_accident()
        except AssertionError:
            complaints.append(f"payload: {run.ended.err[-600:]}")
        if not (run.killed or run.unborn) and run.ended.status not in (0, 3):
            complaints.append(f"payload: ended with status {run.ended.status}")
    try:
        world.service.assert_no_accident()
    except AssertionError as error:
        complaints.append(f"service: {str(error)[-900:]}")
    heard = {who for who, _, _ in world.heard.payloads} | set(world.heard.shown)
    complaints += [f"service: it heard {who}" for who in sorted(heard - world.guests - {NAME})]
    return complaints
