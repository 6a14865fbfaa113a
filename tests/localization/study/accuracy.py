"""Rows about a flight that goes on: rate, accuracy, shutter, covariance, the red kitchen."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from study.feeding import Flight, Run, close, feed, load_flight, make_localizer
from study.metrics import (
    consistency,
    largest,
    longest_span_s,
    pose_errors,
    rmse,
    tangent_errors,
    without_numbers,
)
from study.plain import PlainLocalizer
from study.row import Line, Row, Study, seeds, start_from_truth, thesis, ungated

from ground_station.geometry.camera import Camera
from ground_station.geometry.trajectory import read_tum
from ground_station.localization.estimate import State
from ground_station.map.store import Map, load
from ground_station.recording.frames import Frame
from ground_station.recording.open import open_input

PLAIN_STEP = 5
KITCHEN = slice(500, 1000)
_TURNS = 3


def throughput(study: Study) -> Row:
    """From the file to poses, decoding included, as fast as it can; the median of three turns."""
    flight_about = load_flight(study.demo, 1)
    turns: list[dict[str, float]] = []
    for _ in range(_TURNS):
        source = open_input(study.demo)
        assert source.camera is not None
        localizer = make_localizer(study.map_, source.camera, study.settings)
        begin = time.perf_counter()
        run = feed(localizer, islice(source, study.limit))
        close(localizer)
        took_ms = 1e3 * np.diff([begin, *run.done_s])
        p50, p99 = np.percentile(took_ms, [50, 99])
        rate = 1e3 / took_ms.mean()
        turns.append({"frames": len(took_ms), "rate_hz": rate, "p50_ms": p50, "p99_ms": p99})
    rate = float(np.median([turn["rate_hz"] for turn in turns]))
    p99 = float(np.median([turn["p99_ms"] for turn in turns]))
    p50 = float(np.median([turn["p50_ms"] for turn in turns]))
    cores = len(os.sched_getaffinity(0))
    figure = f"{rate:.1f} frames/s; {p50:.1f} ms median, {p99:.1f} ms p99 on {cores} cores"
    bound = ">= 30 frames/s, p99 <= 50 ms"
    line = Line("throughput", bound, figure, rate >= 30 and p99 <= 50, flight_about.about)
    return Row([line], {"turns": turns, "cores": cores})


def accuracy(run: Run, flight: Flight) -> dict[str, Any]:
    """The figures of a flight against its truth, causal and unaligned."""
    metres, degrees = run.errors(flight.true_wTc(run.frames))
    tracking, lost = run.says(State.TRACKING), run.says(State.LOST)
    first = int(tracking.argmax()) if tracking.any() else None
    return {
        "flight": flight.about,
        "frames": len(run.frames),
        "dropped": run.dropped,
        "localized": int(run.localized.sum()),
        "not_localized": int((~run.localized).sum()),
        "rmse_m": rmse(metres),
        "rmse_deg": rmse(degrees),
        "median_m": float(np.nanmedian(metres)) if run.localized.any() else float("nan"),
        "max_m": largest(metres),
        "max_deg": largest(degrees),
        "tracking_share": float(tracking.mean()),
        "first_tracking_frame": first,
        "rmse_tracking_m": rmse(metres[tracking]),
        "max_tracking_m": largest(metres[tracking]),
        "max_tracking_deg": largest(degrees[tracking]),
        "longest_lost_s": longest_span_s(run.time_ns, lost),
        "states": {state.value: int(run.says(state).sum()) for state in State},
        "frame_ms": {
            "median": float(np.median(run.took_ms)),
            "mean": float(np.mean(run.took_ms)),
            "p99": float(np.percentile(run.took_ms, 99)),
        },
        "late_s": {"p99": float(np.percentile(run.late_s, 99))} if run.late_s else None,
        "reasons": _counts([e.reason for e in run.estimates if e.state is not State.TRACKING]),
    }


def _counts(reasons: list[str]) -> dict[str, int]:
    """How often each reason was given, numbers aside; the most frequent eight."""
    return dict(Counter(map(without_numbers, reasons)).most_common(8))


def demo(study: Study) -> Row:
    """The demo flight, causal and unaligned, and a plain loop beside it."""
    flight = study.flight(study.demo)
    run = study.fly(study.demo)
    ours = accuracy(run, flight)
    met = (
        ours["rmse_m"] <= 0.02 and ours["rmse_deg"] <= 0.15 and ours["tracking_share"] >= 0.99
    )  # fmt: skip
    figure = (
        f"{ours['rmse_m']:.4f} m, {ours['rmse_deg']:.3f} deg; {ours['tracking_share']:.1%} TRACKING"
    )
    some = run.frames[::PLAIN_STEP]
    true_wTc = flight.true_wTc(some)
    plain, took = fly_plainly(study.map_, flight.camera, some)
    m, deg = pose_errors(plain, true_wTc)
    own_m, own_deg = pose_errors(run.wTc[::PLAIN_STEP], true_wTc)
    both = np.isfinite(m) & np.isfinite(own_m)
    beside = {
        "frames": len(some),
        "localized": int(np.isfinite(m).sum()),
        "rmse_m": rmse(m),
        "rmse_deg": rmse(deg),
        "median_m": float(np.nanmedian(m)),
        "max_m": largest(m),
        "frame_ms": {"median": float(np.median(took)), "mean": float(np.mean(took))},
        "ours_rmse_m": rmse(own_m),
        "ours_rmse_deg": rmse(own_deg),
        "both": {"plain_rmse_m": rmse(m[both]), "ours_rmse_m": rmse(own_m[both])},
        "times_faster": float(np.mean(took) / ours["frame_ms"]["mean"]),
    }
    what = f"  SIFT, all landmarks, RANSAC (every {PLAIN_STEP}th)"
    other = (
        f"{beside['rmse_m']:.4f} m, {beside['rmse_deg']:.3f} deg, "
        f"{beside['localized']}/{len(some)} frames, {beside['frame_ms']['mean']:.0f} ms; "
        f"ours there {beside['ours_rmse_m']:.4f} m, {beside['times_faster']:.1f}x faster"
    )
    better = beside["ours_rmse_m"] <= beside["rmse_m"] and beside["times_faster"] >= 10
    about = seeds([flight])
    lines = [
        Line("demo flight", "<= 0.02 m, <= 0.15 deg, >= 99 % TRACKING", figure, met, about),
        Line(what, "ours no worse, 10x faster", other, better, about),
    ]
    return Row(lines, {"default": ours, "plain": beside})


def fly_plainly(
    map_: Map, camera: Camera, frames: Sequence[Frame]
) -> tuple[npt.NDArray[np.float64], list[float]]:
    """Poses (N, 4, 4) by the plain loop, NaN where it finds none, and each frame's milliseconds."""
    plain = PlainLocalizer(map_, camera)
    found, took = [], []
    for frame in frames:
        begin = time.perf_counter()
        wTc = plain.locate(frame.image)
        took.append(1e3 * (time.perf_counter() - begin))
        found.append(np.full((4, 4), np.nan) if wTc is None else wTc)
    return np.array(found).reshape(-1, 4, 4), took


def fast(study: Study) -> Row:
    """Fast flights: the default, the same without a model of the rolling shutter, the thesis."""
    lines: list[Line] = []
    data: dict[str, Any] = {}
    for spec in study.fast:
        flight = study.flight(spec)
        found = {"default": accuracy(study.fly(spec), flight)}
        variants = {
            "no rolling shutter": (replace(flight.camera, readout_s=0.0), study.settings),
            "thesis": (flight.camera, thesis()),
            "thesis, no frame gated": (flight.camera, ungated(thesis())),
        }
        for name, (camera, settings) in variants.items():
            localizer = make_localizer(study.map_, camera, settings)
            if not settings.recovery.relocalize:
                start_from_truth(localizer, flight, flight.frames)
            # The thesis's way takes a third of a second a frame: pacing would measure only that.
            run = feed(localizer, flight.frames)
            close(localizer)
            found[name] = accuracy(run, flight)
        ours, off = found["default"], found["no rolling shutter"]
        fall = 1 - ours["rmse_m"] / off["rmse_m"]
        fall_deg = 1 - ours["rmse_deg"] / off["rmse_deg"]
        met = {
            "default": ours["rmse_m"] <= 0.05 and ours["longest_lost_s"] <= 1,
            "no rolling shutter": fall >= 0.3,
        }
        bounds = {
            "default": "<= 0.05 m, LOST <= 1 s",
            "no rolling shutter": "the model: error falls by >= 30 %",
        }
        for name, f in found.items():
            figure = (
                f"{f['rmse_m']:.4f} m, {f['rmse_deg']:.3f} deg; {f['not_localized']} of "
                f"{f['frames']} not localized, LOST {f['longest_lost_s']:.2f} s; "
                f"max {f['max_tracking_m']:.3f} m TRACKING"
            )
            if name == "no rolling shutter":
                figure += f"; falls {fall:.0%} (m), {fall_deg:.0%} (deg)"
            what = "fast flight" if name == "default" else f"  {name}"
            lines.append(Line(what, bounds.get(name, ""), figure, met.get(name), flight.about))
        data[flight.about] = found | {"falls": {"position": fall, "rotation": fall_deg}}
    return Row(lines, data)


def covariance(study: Study) -> Row:
    """How many frames' true poses are inside the 95 % ellipsoids of the published covariances."""
    lines: list[Line] = []
    data: dict[str, Any] = {}
    every_xi, every_C, good = [], [], True
    for spec in study.flights:
        flight, run = study.flight(spec), study.fly(spec)
        had = np.array([e.localized and e.covariance is not None for e in run.estimates], bool)
        told = [e for e, ok in zip(run.estimates, had, strict=True) if ok]
        xi = tangent_errors(run.wTc[had], flight.true_wTc(run.frames)[had])
        C = np.array([e.covariance for e in told], np.float64).reshape(-1, 6, 6)
        found = consistency(xi, C)
        found["by_state"] = {
            state.value: consistency(xi[mask], C[mask])
            for state in State
            if (mask := np.array([e.state is state for e in told], bool)).any()
        }
        tracked = np.array([e.tracked for e in told], bool)
        found["by_way"] = {
            name: consistency(xi[mask], C[mask])
            for name, mask in (("tracked", tracked), ("own features", ~tracked))
            if mask.any()
        }
        data[flight.about] = found
        share = float(found["inside_95"])
        good &= 0.85 <= share <= 0.995
        lines.append(_line_of(found, "  one flight", "85-99.5 %", 0.85, 0.995, flight.about))
        every_xi.append(xi)
        every_C.append(C)
    whole = consistency(np.concatenate(every_xi), np.concatenate(every_C))
    about = seeds([study.flight(spec) for spec in study.flights])
    first = _line_of(whole, "covariance, all flights", "90-99 %", 0.90, 0.99, about)
    return Row([first, *lines], {"all": whole, "flights": data, "each_within": good})


def _line_of(
    found: dict[str, Any], what: str, bound: str, low: float, high: float, about: str
) -> Line:
    axes = " ".join(f"{ratio:.2f}" for ratio in found["axis_ratio"])
    figure = (
        f"{found['inside_95']:.1%} of {found['frames']}; mean NEES {found['mean_nees']:.2f} (6), "
        f"rot {found['rotation_inside_95']:.0%}, trans {found['translation_inside_95']:.0%}; "
        f"error/sigma {axes}"
    )
    return Line(what, bound, figure, bool(low <= found["inside_95"] <= high), about)


def kitchen(study: Study) -> Row:
    """The red kitchen's query pass as a 30 Hz stream without a first pose."""
    folder = study.kitchen
    flight = load_flight(f"{folder / 'frames'}@{folder / 'camera.toml'}", None, "500:1000")
    map_ = load(study.kitchen_map)
    localizer = make_localizer(map_, flight.camera, study.settings)
    run = study.feed(localizer, flight.frames)
    close(localizer)
    truth = read_tum(Path(folder) / "pseudo_groundtruth.txt")
    judged = [
        (k, truth.nearest(frame.time_ns))
        for k, frame in enumerate(run.frames)
        if abs(int(truth.time_ns[truth.nearest(frame.time_ns)]) - frame.time_ns) < 5_000_000
    ]
    ours = np.array([k for k, _ in judged], np.intp)
    metres, degrees = pose_errors(run.wTc[ours], truth.wTc[[j for _, j in judged]])
    index = np.array([frame.index for frame in run.frames])
    tracking = run.says(State.TRACKING)
    first = int(index[tracking.argmax()]) if tracking.any() else None
    after = index[ours] >= 516
    within = (metres <= 0.02) & (degrees <= 1.0)
    # A frame that was dropped is not among the run's, and has failed.
    wanted = sum(
        1 for frame in flight.frames if frame.index >= 516 and _is_near(truth.time_ns, frame)
    )
    share = float(within[after].sum() / max(wanted, 1))
    median_m = float(np.nanmedian(np.where(after, metres, np.nan)))
    median_deg = float(np.nanmedian(np.where(after, degrees, np.nan)))
    met = (
        first is not None and first <= 515 and share >= 0.98
        and median_m <= 0.006 and median_deg <= 0.25
    )  # fmt: skip
    said = tracking[ours]
    data: dict[str, Any] = {
        "first_tracking_frame": first,
        "judged": wanted,
        "share_2cm_1deg": share,
        "median_m": median_m,
        "median_deg": median_deg,
        "rmse_m": rmse(metres[after]),
        "max_tracking_m": largest(metres[said]),
        "max_tracking_deg": largest(degrees[said]),
        "missed": [
            [int(i), float(m), float(d), run.estimates[k].state.value, run.estimates[k].reason]
            for i, m, d, k, ok in zip(index[ours], metres, degrees, ours, within, strict=True)
            if i >= 516 and not ok
        ],
        "dropped": run.dropped,
        "states": {state.value: int(run.says(state).sum()) for state in State},
        "frame_ms": {"median": float(np.median(run.took_ms)), "mean": float(np.mean(run.took_ms))},
    }
    figure = (
        f"TRACKING at {first}; {share:.1%} of {wanted} within 2 cm and 1 deg; "
        f"median {1e3 * median_m:.1f} mm, {median_deg:.3f} deg"
    )
    bound = "TRACKING by 515; >= 98 %; <= 6 mm, <= 0.25 deg"
    mine = [k for k in ours if index[k] >= 516]
    plain, took = fly_plainly(map_, flight.camera, [run.frames[k] for k in mine])
    m, deg = pose_errors(plain, truth.wTc[[j for k, j in judged if index[k] >= 516]])
    data["plain"] = {
        "share_2cm_1deg": float(((m <= 0.02) & (deg <= 1.0)).sum() / max(wanted, 1)),
        "median_m": float(np.nanmedian(m)),
        "median_deg": float(np.nanmedian(deg)),
        "frame_ms": {"median": float(np.median(took)), "mean": float(np.mean(took))},
    }
    beside = (
        f"{data['plain']['share_2cm_1deg']:.1%}; median {1e3 * np.nanmedian(m):.1f} mm, "
        f"{np.nanmedian(deg):.3f} deg; {np.mean(took):.0f} ms"
    )
    return Row(
        [
            Line("red kitchen, query pass", bound, figure, met, "real"),
            Line("  SIFT, all landmarks, RANSAC (the same map)", "", beside, None, "real"),
        ],
        data,
    )


def _is_near(times_ns: np.ndarray, frame: Any) -> bool:
    return bool(np.abs(times_ns - frame.time_ns).min() < 5_000_000)
