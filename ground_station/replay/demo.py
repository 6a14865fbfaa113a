"""`make demo`: map the sample building from one flight, fly another, localize it live."""

from __future__ import annotations

import shutil
import time
from dataclasses import asdict
from pathlib import Path

from ground_station.errors import InputError
from ground_station.map.store import Map
from ground_station.mapping.construction.build import build_map
from ground_station.mapping.construction.inputs import open_inputs
from ground_station.mapping.registration.observations import read_pairs
from ground_station.mapping.registration.register import register_map
from ground_station.mapping.settings import load_settings
from ground_station.replay import flight_report
from ground_station.replay.replay import replay, settings_for
from ground_station.service.settings import SAMPLE
from pi_firmware.wire.recording import RecordingReader

LIMITS = {
    flight_report.GATED: 5.0,
    flight_report.LOCALIZED: 95.0,
    flight_report.POSITION: 0.05,
    flight_report.ROTATION: 0.3,
}
"""Accuracy and coverage only: a slow machine must not fail the demo."""


def run(
    out: Path, *, preset: str, init: str | None, rate_hz: float | None, sample: Path = SAMPLE
) -> int:
    """Builds, flies, writes results and report to `out`; 1 when a bound is missed."""
    mapping, flight = sample / "mapping.mcap", sample / "flight.mcap"
    for path in (mapping, flight, sample / "mapping.toml", sample / "PAIRS.csv"):
        if not path.is_file():
            raise InputError(f"{path}: the sample is incomplete; `make sample` makes it again")
    out.mkdir(parents=True, exist_ok=True)
    print("1 of 3: a map of the atrium from the mapping flight", flush=True)
    start_s = time.monotonic()
    map_ = build(mapping, sample, out / "map")
    map_s = time.monotonic() - start_s
    settings = settings_for(preset, flight, rate_hz=rate_hz, init=init)
    print(
        f"2 of 3: the other flight, streamed by the firmware at {settings.rate_hz:g} Hz", flush=True
    )
    start_s = time.monotonic()
    result = replay(map_, settings)
    flown_s = time.monotonic() - start_s
    print("3 of 3: the report\n", flush=True)
    report = flight_report.report_of(
        "Demo: a flight through the sample atrium",
        result,
        map_,
        seconds=flown_s,
        bounds=flight_report.judge(result, LIMITS),
        seeds={
            "mapping flight": _seed(mapping),
            "localization flight": _seed(flight),
            "map": int(map_.info.built["settings"]["seed"]),
            "localizer": result.localizer.seed,
        },
    )
    flight_report.publish(
        out,
        report,
        seeds=report.seeds,
        map={"build_s": map_s, **map_.info.built, "registration": map_.info.registration},
        bounds=[asdict(bound) for bound in report.bounds],
        simulated=True,
    )
    return 0 if report.passed and result.live.complete else 1


def build(mapping: Path, sample: Path, folder: Path) -> Map:
    """The registered map of the sample's mapping flight."""
    settings = load_settings(sample / "mapping.toml")
    inputs = open_inputs([str(mapping)], settings)
    build_map(inputs, inputs.camera, settings, folder, total=inputs.total, built=inputs.built)
    registered, found = register_map(
        folder, observations=read_pairs(sample / "PAIRS.csv"), source="PAIRS.csv"
    )
    for note in found.notes:
        print(note)
    for name in ("floorplan.png", "floorplan.yaml"):
        shutil.copyfile(sample / name, folder / name)
    return registered


def _seed(recording: Path) -> int:
    table = RecordingReader(recording).metadata_table("simulation")
    return int(table.get("seed", "0"))
