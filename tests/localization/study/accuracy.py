"""Rows about a flight that goes on: accuracy, shutter, covariance."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from study.feeding import Flight, Run, close, feed, make_localizer
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

from ground_station.arrays import F64
from ground_station.geometry.camera import Camera
from ground_station.localization.estimate import State
from ground_station.map.store import Map
from ground_station.recording.frames import Frame

PLAIN_STEP = 5


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


def fly_plainly(map_: Map, camera: Camera, frames: Sequence[Frame]) -> tuple[F64, list[float]]:
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
