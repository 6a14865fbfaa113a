"""From experiments to jobs: each flight, map and run once, with what it needs and depends on.

On the program a result depends by a hash of rooms' code that comments do not change.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from ground_station.errors import InputError
from ground_station.experiments.alter import Alteration
from ground_station.experiments.declaration import (
    Case,
    Declaration,
    FlightDeclaration,
    MapSpec,
    changed,
)
from ground_station.experiments.flights import stem
from ground_station.features import extractors
from ground_station.geometry.camera import Camera
from ground_station.localization.settings import LocalizerSettings, load_preset
from ground_station.mapping.settings import MappingSettings
from ground_station.simulator.plans import camera_of


@dataclass(frozen=True)
class LensJob:
    """Calibrates a camera by a film of a board into `flights/<name>`, a camera's file."""

    key: str
    name: str
    camera: Camera
    processing: str
    seed: int


@dataclass(frozen=True)
class FlightJob:
    """Simulates a flight into `flights/<name>`."""

    key: str
    name: str
    flight: FlightDeclaration
    seed: int


@dataclass(frozen=True)
class MapJob:
    """Builds a map in `maps/<key>`; `recording` is the name of the flight's, None: real ones.

    `lens` is the name of what calibration found of its camera, None: it is known.
    """

    key: str
    spec: MapSpec
    settings: MappingSettings
    recording: str | None
    lens: str | None = None


@dataclass(frozen=True)
class RunJob:
    """Localizes a flight in a map; its figures go to `runs/<key>.json`."""

    key: str
    map_key: str
    flight: FlightDeclaration
    recording: str | None
    seed: int
    alter: Alteration
    preset: str
    settings: LocalizerSettings
    lens: str | None = None


Job = LensJob | FlightJob | MapJob | RunJob


@dataclass(frozen=True)
class Plan:
    """All jobs by key, each before those that need it; `runs[case][preset]` are keys by seed."""

    jobs: dict[str, Job]
    needs: dict[str, tuple[str, ...]]
    runs: dict[tuple[str, str], dict[str, list[str]]]


def make(declaration: Declaration, mapping: MappingSettings, data: Path) -> Plan:
    """The jobs of experiments; raises `ConfigError` or `InputError` before anything is worked.

    Real pictures have one seed, for they are flown once.
    """
    plan = Plan({}, {}, {})
    for experiment in declaration.experiments:
        for case in experiment.cases:
            _check_features(case)
            mine = {preset: _runs(plan, case, preset, declaration, mapping, data)
                    for preset in case.presets}  # fmt: skip
            plan.runs[case.experiment, case.name] = mine
    return plan


def _runs(
    plan: Plan,
    case: Case,
    preset: str,
    declaration: Declaration,
    mapping: MappingSettings,
    data: Path,
) -> list[str]:
    where = f"experiment '{case.experiment}', case '{case.name}', preset '{preset}'"
    alter = Alteration.of(case.alter, where)
    settings = load_preset("default")  # of `alone` its features' only
    if preset != "alone":
        settings = changed(load_preset(preset), case.localizer, where)
    spec, flight = case.map, case.flight
    map_job = _map(plan, spec, mapping, data)
    seeds = declaration.seeds if flight.simulated else declaration.seeds[:1]
    keys = []
    for seed in seeds:
        flown = _flown(plan, flight, seed, data)
        depends = {
            "map": map_job.key,
            "flight": flown.depends,
            "seed": seed,
            "alter": case.alter,
            "preset": preset,
            "settings": asdict(settings),
            "code": code_sha256("run"),
        }
        key = _key("run", depends)
        job = RunJob(
            key, map_job.key, flight, flown.recording, seed, alter, preset, settings,
            flown.lens,
        )  # fmt: skip
        _add(plan, job, (map_job.key, *flown.needs))
        keys.append(key)
    return keys


def _map(plan: Plan, spec: MapSpec, mapping: MappingSettings, data: Path) -> MapJob:
    flown = _flown(plan, spec.flight, spec.seed, data)
    depends = {
        "flight": flown.depends,
        "spec": asdict(spec),
        "features": _sha256(spec.features),
        "settings": asdict(mapping),
        "code": code_sha256("map"),
    }
    job = MapJob(_key("map", depends), spec, mapping, flown.recording, flown.lens)
    _add(plan, job, flown.needs)
    return job


@dataclass(frozen=True)
class _Flown:
    """On what of a flight a result `depends`, what the jobs that it `needs` leave in `flights`."""

    depends: str
    recording: str | None = None
    lens: str | None = None
    needs: tuple[str, ...] = ()


def _flown(plan: Plan, flight: FlightDeclaration, seed: int, data: Path) -> _Flown:
    if not flight.simulated:
        return _Flown(_real(flight, data))
    # It is flown as well whatever is known of its camera.
    taken = replace(flight, calibrated=False)
    key = _key("flight", {"flight": asdict(taken), "seed": seed, "code": code_sha256("flight")})
    job = FlightJob(key, f"{stem(taken, seed)}-{key[:8]}.mcap", taken, seed)
    _add(plan, job, ())
    if not flight.calibrated:
        return _Flown(key, job.name, None, (key,))
    lens = _lens(plan, camera_of(flight.plan), flight.processing, seed)
    return _Flown(f"{key} {lens.key}", job.name, lens.name, (key, lens.key))


def _lens(plan: Plan, camera: Camera, processing: str, seed: int) -> LensJob:
    depends = {
        "camera": camera.as_dict(),
        "processing": processing,
        "seed": seed,
        "code": code_sha256("lens"),
    }
    key = _key("lens", depends)
    job = LensJob(key, f"lens-{seed}-{key[:8]}.toml", camera, processing, seed)
    _add(plan, job, ())
    return job


def _add(plan: Plan, job: Job, needs: tuple[str, ...]) -> None:
    plan.jobs.setdefault(job.key, job)
    plan.needs.setdefault(job.key, needs)


def _key(kind: str, depends: dict[str, Any]) -> str:
    text = json.dumps({"kind": kind, **depends}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:24]


@functools.cache
def _sha256(features: str) -> str:
    return extractors.create(features, 50).sha256


def _check_features(case: Case) -> None:
    if case.map.features not in extractors.names():
        known = ", ".join(extractors.names())
        raise InputError(
            f"experiment '{case.experiment}', case '{case.name}': there is no extractor "
            f"'{case.map.features:.60}' (known: {known})"
        )


@functools.cache
def _real(flight: FlightDeclaration, data: Path) -> str:
    """A hash of real pictures by name and size, of their camera and trajectory by content."""
    folder = data / flight.folder
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder; --data says where real pictures are")
    whole = hashlib.sha256()
    for path in sorted(folder.iterdir()):
        whole.update(f"{path.name}\0{path.stat().st_size}\n".encode())
    for name in (flight.truth, flight.camera):
        path = data / name
        if not name or not path.is_file():
            raise InputError(f"{path}: there is no such file")
        whole.update(path.read_bytes())
    whole.update(f"{flight.range}\0{flight.rate_hz}".encode())
    return whole.hexdigest()


_ROOT = Path(__file__).resolve().parents[1]

ROOMS = {
    "lens": ("experiments/lenses.py", "simulator", "geometry", "calibration", "recording"),
    "flight": ("experiments/flights.py", "simulator", "geometry"),
    "map": ("experiments/maps.py", "experiments/material.py", "map", "mapping", "features",
            "geometry", "recording"),
    "run": ("experiments/measure.py", "experiments/alter.py",
            "experiments/disturbance.py", "experiments/disturbances",
            "experiments/maps.py", "experiments/material.py",
            "evaluation/ate.py", "localization", "map/store.py", "map/descriptors.py",
            "map/uncertainty.py",
            "features", "geometry", "recording"),
}  # fmt: skip
"""By kind of result, what makes it, below this package."""


@functools.cache
def code_sha256(kind: str) -> str:
    """Of the code that makes results of that kind: its syntax trees and TOML files, by name."""
    whole = hashlib.sha256()
    for room in ROOMS[kind]:
        path = _ROOT / room
        files = sorted(path.rglob("*")) if path.is_dir() else [path]
        for file in files:
            if file.suffix == ".py":
                whole.update(f"{file.relative_to(_ROOT)}\0{_meaning(file.read_text())}\n".encode())
            elif file.suffix == ".toml":
                whole.update(f"{file.relative_to(_ROOT)}\0".encode() + file.read_bytes())
    return whole.hexdigest()


def _meaning(source: str) -> str:
    """A module without comments, layout and docstrings."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            # Attributes' docs are bare strings, too.
            node.body = [s for s in body if not _is_text(s)]  # type: ignore[attr-defined]
    return ast.dump(tree)


def _is_text(statement: ast.AST) -> bool:
    return (
        isinstance(statement, ast.Expr)
        and isinstance(statement.value, ast.Constant)
        and isinstance(statement.value.value, str)
    )
