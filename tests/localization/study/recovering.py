"""Rows about being lost: kidnapping, other buildings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from study.feeding import Flight, Run, feed, joined, make_localizer
from study.metrics import (
    NEAR_DEG,
    NEAR_M,
    percentile_of,
    pose_errors,
    recovery,
    without_numbers,
)
from study.row import Line, Row, Study, seeds

from ground_station.localization.attempt import Conditions
from ground_station.localization.estimate import State
from ground_station.localization.extraction import extractor_for
from ground_station.localization.matching import describe
from ground_station.localization.relocalization import Relocalizer

BEFORE = 30
"""Frames of a flight before a jump: a second."""
AFTER = 150
"""And after it at most: five seconds."""
SETTLED = 20
"""Frames that say TRACKING near the truth one after the other: a jump is over."""
_RATE_HZ = 30.0


def draw_places(
    flights: Sequence[Flight], rng: np.random.Generator, before: int, after: int
) -> tuple[int, int, int, int]:
    """A flight and a first frame before, and another flight and a first frame after a jump."""
    a = int(rng.integers(len(flights)))
    b = int((a + rng.integers(1, len(flights))) % len(flights)) if len(flights) > 1 else a
    i = int(rng.integers(max(1, len(flights[a].frames) - before)))
    j = int(rng.integers(max(1, len(flights[b].frames) - after)))
    return a, i, b, j


class Settled:
    """Whether a run has said TRACKING near the truth for `SETTLED` frames since a jump."""

    def __init__(self, first: int, truth: np.ndarray) -> None:
        self._first, self._truth, self._count = first, truth, 0

    def __call__(self, run: Run) -> bool:
        frame, estimate = run.frames[-1], run.estimates[-1]
        near = False
        if frame.index >= self._first and estimate.wTc is not None:
            m, deg = pose_errors(estimate.wTc, self._truth[frame.index - self._first])
            near = bool(m[0] <= NEAR_M and deg[0] <= NEAR_DEG)
        self._count = self._count + 1 if near and estimate.state is State.TRACKING else 0
        return self._count >= SETTLED


def kidnapping(study: Study) -> Row:
    """A second of one flight, then at once a place of another; from truth, then on its own."""
    flights = [study.flight(spec) for spec in study.flights]
    rng = np.random.default_rng(study.seed)
    jumps: list[dict[str, Any]] = []
    for _ in range(study.jumps):
        a, i, b, j = draw_places(flights, rng, BEFORE, AFTER)
        jumps.append(_jump(study, flights[a], i, flights[b], j))
    times = [jump["recovered_s"] for jump in jumps]
    p50, p95 = percentile_of(times, 50), percentile_of(times, 95)
    wrong = [jump for jump in jumps if jump["wrong"]]
    worst_m = float(np.nanmax([jump["worst_m"] for jump in jumps]))
    worst_deg = float(np.nanmax([jump["worst_deg"] for jump in jumps]))
    within = float(np.mean([t <= 1.0 for t in times]))
    data = {
        "jumps": len(jumps),
        "median_s": p50,
        "p95_s": p95,
        "within_1_s": within,
        "never": sum(not np.isfinite(t) for t in times),
        "wrong_jumps": len(wrong),
        "wrong_frames": sum(jump["wrong"] for jump in jumps),
        "kept_s_max": max(jump["kept_s"] for jump in jumps),
        "worst_m": worst_m,
        "worst_deg": worst_deg,
        "distribution_s": sorted(times),
        "each": jumps,
    }
    figure = (
        f"median {p50:.2f} s, p95 {p95:.2f} s, {within:.1%} in 1 s; {len(wrong)} jumps with a "
        f"wrong TRACKING (kept <= {data['kept_s_max']:.2f} s), worst {worst_m:.3f} m, "
        f"{worst_deg:.2f} deg"
    )
    met = p50 <= 0.5 and p95 <= 1.0 and not wrong
    bound = "median <= 0.5 s, 95 % in 1 s, TRACKING within 0.25 m, 2 deg"
    about = f"{seeds(flights)}; jumps {study.seed}"
    return Row([Line(f"kidnapping, {len(jumps)} jumps", bound, figure, met, about)], data)


def _jump(study: Study, before: Flight, i: int, after: Flight, j: int) -> dict[str, Any]:
    old = before.frames[i : i + BEFORE]
    new = after.frames[j : j + AFTER]
    stream = joined([old, new], _RATE_HZ)
    localizer = make_localizer(study.map_, after.camera, study.settings)
    localizer.set_initial_pose(before.true_wTc(old[:1])[0], stream[0].time_ns)
    true_wTc = after.true_wTc(new)
    run = feed(localizer, stream, Settled(len(old), true_wTc))
    there = np.array([frame.index >= len(old) for frame in run.frames], bool)
    kept = [frame.index - len(old) for frame in run.frames if frame.index >= len(old)]
    m, deg = (values[there] for values in run.errors(_padded(true_wTc[kept], there)))
    found = recovery(np.array(kept) / _RATE_HZ, run.says(State.TRACKING)[there], m, deg)
    return {
        "from": [before.about, i],
        "to": [after.about, j],
        "tracking_before": bool(run.estimates[int(there.argmax()) - 1].state is State.TRACKING),
        **vars(found),
        "states": "".join(e.state.value[0] for e, t in zip(run.estimates, there, strict=True) if t),
    }


def _padded(truth: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Poses (N, 4, 4) at the frames that have them, identities elsewhere."""
    result = np.tile(np.eye(4), (len(where), 1, 1))
    result[where] = truth
    return result


def other_buildings(study: Study) -> Row:
    """Frames of other buildings, each on its own and as streams: none may be accepted."""
    flights = [study.flight(spec) for spec in study.others]
    alone = ask_alone(study, flights)
    streams: dict[str, Any] = {}
    for flight in flights:
        localizer = make_localizer(study.map_, flight.camera, study.settings)
        run = feed(localizer, flight.frames)
        streams[f"{flight.name}: {flight.about}"] = {
            "frames": len(run.frames),
            "localized": int(run.localized.sum()),
            "tracking": int(run.says(State.TRACKING).sum()),
        }
    streamed, localized, tracking = (
        sum(one[key] for one in streams.values()) for key in ("frames", "localized", "tracking")
    )
    figure = (
        f"{len(alone['accepted'])} of {alone['frames']} alone; as streams {tracking} TRACKING, "
        f"{localized} localized of {streamed}"
    )
    met = not alone["accepted"] and not tracking and not localized
    line = Line("frames of other buildings", "0 accepted", figure, met, seeds(flights))
    return Row([line], {"alone": alone, "streams": streams})


def ask_alone(study: Study, flights: Sequence[Flight]) -> dict[str, Any]:
    """Asks for the place of `study.count` frames, each with no frame before it."""
    every = [(k, frame) for k, flight in enumerate(flights) for frame in flight.frames]
    step = max(1.0, len(every) / study.count)
    chosen = [every[int(k * step)] for k in range(min(study.count, len(every)))]
    settings = study.settings
    extractor = extractor_for(study.map_.info, settings.features)
    finders = [Relocalizer(study.map_, f.camera, settings.recovery, settings.seed) for f in flights]
    accepted, refused = [], Counter[str]()
    for k, frame in chosen:
        features = extractor.extract(frame.image)
        seen = describe(features, flights[k].camera, Conditions())
        found = finders[k].candidates(seen)
        if not isinstance(found, str):
            found = finders[k].alone(found)
        if isinstance(found, str):
            refused[without_numbers(found)] += 1
        else:
            accepted.append({"flight": flights[k].about, "frame": frame.index})
    return {
        "frames": len(chosen),
        "accepted": accepted,
        "refused": dict(refused.most_common(8)),
    }
