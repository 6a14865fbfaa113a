"""What is flown, mapped and compared: `experiments.toml` as checked, plain values; made short."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

from ground_station.errors import InputError
from ground_station.recording.frames import FrameRange
from ground_station.recording.open import parse_range
from ground_station.simulator.processing import PROCESSINGS
from pi_firmware.wire import config
from pi_firmware.wire.errors import ConfigError

SHIPPED = Path(__file__).with_name("experiments.toml")
PRESETS = ("thesis", "alone", "default")
"""They localize the same frames, in this order of columns; `alone` is each frame by itself."""

FIGURES = ("position_m", "rotation_deg", "smoothed_m", "p95_m", "recovery_s", "first_s", "gap_s",
           "inside_95", "registration_m")  # fmt: skip
"""Of a run, one number each, that are averaged over the seeds."""

STATISTICS = ("mean", "min", "max", "median", "p95")
"""Of a claim's figure, over the runs that it is about."""

T = TypeVar("T")
Table = Mapping[str, Any]


@dataclass(frozen=True)
class FlightDeclaration:
    """A flight: simulated, or where `folder` is given, real pictures with their trajectory."""

    scene: str = config.key("atrium", "of the simulator")
    plan: str = config.key("loop", "of the simulator")
    light: str = config.key("noon", "of the simulator")
    duration_s: float = config.key(20.0, "length", unit="s", low=0.5, high=3600)
    rate_hz: float = config.key(15.0, "frames a second", unit="Hz", low=0.1, high=120)
    bitrate_kbps: int = config.key(
        0, "of the video; 0: good quality whatever it takes", unit="kbit/s", low=0, high=100000
    )
    draught_m_s: float | None = config.key(
        None, "deviation of the air's speed, which makes the blimp swing", unit="m/s", low=0, high=2
    )
    people: int = config.key(0, "who walk back and forth", low=0, high=100)
    storey_m: float = config.key(
        0.0,
        "height of its floor above the map's, which has nothing of it",
        unit="m",
        low=0,
        high=100,
    )
    exposure_steps: str = config.key(
        "", "T:EV, ...: from T seconds on exposures are off by EV from what auto exposure asks for"
    )
    light_steps: str = config.key("", "T:SHARE, ...: from T seconds on, this share of the light")
    flicker: float = config.key(
        0.0, "share by which the light swings, 100 times a second", low=0, high=1
    )
    processing: str = config.key(
        "none", "what the camera makes of its sensor's light", choices=PROCESSINGS
    )
    calibrated: bool = config.key(
        False, "its camera is known by a film of a board, calibrated; otherwise as it is"
    )
    clicked: int = config.key(
        0, "of a map's: points that a person clicks and measured; 0: registered by the true poses",
        unit="points", low=0, high=18,
    )  # fmt: skip
    folder: str = config.key("", "pictures below --data instead of a simulation")
    truth: str = config.key("", "their trajectory below --data, TUM text")
    camera: str = config.key("", "their camera below --data")
    range: str = config.key("", "frames A:B or A:B:S of it; none: all")

    @property
    def simulated(self) -> bool:
        """Whether the simulator makes it."""
        return not self.folder


@dataclass(frozen=True)
class MapSpec:
    """A map: of which flight, of how many of its frames, with which features."""

    images: int = config.key(137, "frames, evenly taken; 0: all", unit="frames", low=0, high=5000)
    features: str = config.key("rootsift", "name of the extractor or of a model")
    seed: int = config.key(101, "of the mapping flight", low=0, high=2**31 - 1)
    flight: FlightDeclaration = config.table(FlightDeclaration)


@dataclass(frozen=True)
class Figures:
    """What the thesis printed: from another building and camera."""

    position_m: float | None = config.key(None, "ATE", unit="m", low=0)
    rotation_deg: float | None = config.key(None, "ATE", unit="deg", low=0)
    note: str = config.key("", "what must be said of it")


@dataclass(frozen=True)
class Times:
    """What the thesis printed of a frame's time, seconds, in words: over several maps, on a GPU."""

    features: str = config.key("", "extraction")
    projection: str = config.key("", "of landmarks")
    association: str = config.key("", "by pixel and descriptor")
    pose: str = config.key("", "the factor graph")
    total: str = config.key("", "in all")


@dataclass(frozen=True)
class Claim:
    """What this project says of a row's figure, itself or as a multiple of another row's.

    One bound, `most` or `least`, must be given.
    """

    text: str = config.key("", "as shown")
    row: str = config.key("", "EXPERIMENT.CASE that it is about, or EXPERIMENT: all its runs")
    preset: str = config.key("default", "of the localizer", choices=PRESETS)
    figure: str = config.key("position_m", "of the row", choices=FIGURES)
    statistic: str = config.key("mean", "over the runs", choices=STATISTICS)
    against: str = config.key(
        "", "EXPERIMENT.CASE whose figure is the unit; none: the figure's own"
    )
    most: float | None = config.key(None, "upper bound", low=0.0)
    least: float | None = config.key(None, "lower bound", low=0.0)


@dataclass(frozen=True)
class Row:
    """What an experiment, or a case of it on top, may say: a map, a flight and settings."""

    title: str = config.key("", "as shown")
    question: str = config.key("", "what is asked")
    thesis_source: str = config.key("", "where the thesis has its figures")
    thesis_times: Times = config.table(Times)
    level: str = config.key("", "what the cases vary, where that is a number")
    presets: list[str] = config.key(list(PRESETS), "which of the localizer's", choices=PRESETS)
    map: MapSpec = config.table(MapSpec)
    flight: FlightDeclaration = config.table(FlightDeclaration)
    alter: dict[str, Any] = config.key({}, "keys of `disturbances/`, checked by these")
    localizer: dict[str, Any] = config.key({}, "checked by its settings, when a preset is known")
    thesis: Figures = config.table(Figures)
    cause: str = config.key("", "why the default is the worse one here, as far as it is known")


@dataclass(frozen=True)
class Case(Row):
    """One row of a table: each preset localizes its flight, once for each seed."""

    experiment: str = ""
    name: str = ""


@dataclass(frozen=True)
class Experiment(Row):
    """A table."""

    name: str = ""
    cases: list[Case] = field(default_factory=list)


@dataclass(frozen=True)
class Declaration:
    """All experiments, the seeds of their flights, and what is claimed of those that are wanted."""

    seeds: tuple[int, ...]
    experiments: list[Experiment]
    claims: list[Claim] = field(default_factory=list)


@dataclass(frozen=True)
class _File:
    """What stands under `default` holds for every case unless its experiment or itself says
    otherwise; a map flies as its case does unless `map.flight` says otherwise.
    """

    seeds: list[int] = config.key([1, 2, 3, 4, 5], "of the flights", low=0, high=2**31 - 1)
    default: dict[str, Any] = config.key({}, "a `Row`")
    experiment: dict[str, Any] = config.key({}, "a `Row` with a table `case` of such by name")
    claim: dict[str, Any] = config.key({}, "a `Claim` each")

    def __post_init__(self) -> None:
        if not self.seeds or len(set(self.seeds)) < len(self.seeds):
            raise ValueError("'seeds' must be a list of different whole numbers")


def load(path: str | Path = SHIPPED, only: list[str] | None = None) -> Declaration:
    """Reads experiments; `only` names those wanted. Raises `ConfigError` or `InputError`."""
    file, where = config.load(path, _File), str(path)
    names = list(file.experiment) if only is None else only
    for name in names:
        if name not in file.experiment:
            known = ", ".join(file.experiment)
            raise InputError(f"there is no experiment '{name:.60}' (there are: {known})")
    experiments = [_experiment(file, name, where) for name in names]
    return Declaration(tuple(file.seeds), experiments, _claims(file, where))


def _claims(file: _File, where: str) -> list[Claim]:
    """Claims in the order of the file; raises `ConfigError` for one of a row that is not there."""
    rows = set(file.experiment)
    for name in file.experiment:
        experiment = _table(file.experiment, name, f"{where}: experiment")
        rows |= {f"{name}.{case}" for case in _table(experiment, "case", where)}
    found = []
    for name in file.claim:
        at = f"{where}: claim '{name}'"
        claim = config.from_mapping(_table(file.claim, name, f"{where}: claim"), Claim, where=at)
        for key, row in (("row", claim.row), ("against", claim.against)):
            if row not in rows and (row or key == "row"):
                raise ConfigError(f"{at}: '{key}' names '{row:.60}', and there is no such row")
        if (claim.most is None) == (claim.least is None):
            raise ConfigError(f"{at}: one of 'most' and 'least' must be given")
        found.append(claim)
    return found


def without_missing(declared: Declaration, data: Path) -> tuple[Declaration, list[str]]:
    """Without the cases whose real pictures are not below `data`; a line for each experiment."""
    kept, lines = [], []
    for experiment in declared.experiments:
        folders = {
            spec.folder
            for case in experiment.cases
            for spec in (case.flight, case.map.flight)
            if spec.folder and not (data / spec.folder).is_dir()
        }
        if folders:
            lines.append(f"'{experiment.name}': {data / min(folders)}: there is no such folder")
        else:
            kept.append(experiment)
    return dataclasses.replace(declared, experiments=kept), lines


def with_features(declared: Declaration, names: list[str]) -> Declaration:
    """Each row with each of these features in place of its own; what only they told apart is one.

    Claims and the thesis's figures are of the features that the file names, and are left out.
    """

    def row(case: Case, features: str, **said: Any) -> Case:
        map_ = dataclasses.replace(case.map, features=features)
        return dataclasses.replace(case, map=map_, thesis=Figures(), **said)

    experiments = []
    for experiment in declared.experiments:
        cases = experiment.cases
        alike = [row(case, "", name="", title="") for case in cases]
        if all(one == alike[0] for one in alike):
            rows = [row(cases[0], name, name=name, title=name) for name in names]
        else:
            rows = [
                row(case, name, name=f"{case.name}-{name}", title=f"{case.title}, {name}")
                for case in cases
                for name in names
            ]
        experiments.append(dataclasses.replace(experiment, cases=rows))
    return dataclasses.replace(declared, experiments=experiments, claims=[])


def _experiment(file: _File, name: str, where: str) -> Experiment:
    own = dict(_table(file.experiment, name, f"{where}: experiment"))
    where = f"{where}: experiment '{name}'"
    cases = _table(own, "case", where) or {"": {}}
    base = merged(file.default, {key: value for key, value in own.items() if key != "case"})
    head = config.from_mapping(base, Row, where=where)
    title = head.title or name
    made = [
        _case(base, case, _table(cases, case, f"{where}, case"), name, title, where)
        for case in cases
    ]
    return Experiment(**vars(head) | {"title": title}, name=name, cases=made)


def _case(base: Table, name: str, changes: Table, experiment: str, title: str, where: str) -> Case:
    where = f"{where}, case '{name}'"
    whole = merged(base, changes)
    mapped = _table(whole, "map", where)
    # A map is of the case's own surroundings, but not of its alterations, bit rate or pace.
    flown = {k: v for k, v in _table(whole, "flight", where).items() if k in _OF_THE_PLACE}
    flight = merged(flown, _table(mapped, "flight", where))
    row = config.from_mapping(whole | {"map": {**mapped, "flight": flight}}, Row, where=where)
    more = {
        "title": str(changes.get("title", "")) or name or title,
        "presets": [preset for preset in PRESETS if preset in row.presets],
    }
    return Case(**vars(row) | more, experiment=experiment, name=name)


_OF_THE_PLACE = ("scene", "folder", "truth", "camera")


def merged(base: Table, changes: Table) -> dict[str, Any]:
    """`base` with the values of `changes` in it, table by table; neither is changed."""
    result = dict(base)
    for key, value in changes.items():
        old = result.get(key)
        both = isinstance(value, Mapping) and isinstance(old, Mapping)
        result[key] = merged(old, value) if both else value  # type: ignore[arg-type]
    return result


def changed(settings: T, changes: Table, where: str) -> T:
    """Settings with some keys changed, through the same checks as a file's."""
    document = merged(dataclasses.asdict(settings), changes)  # type: ignore[call-overload]
    return config.from_mapping(document, type(settings), where=where)


def _table(document: Table, key: str, where: str) -> Table:
    value = document.get(key, {})
    if not isinstance(value, Mapping):
        raise ConfigError(f"{where}: '{key}' must be a table")
    return value


FLIGHT_S = 5.0
"""Length of a flight."""
IMAGES = 100
"""Most images of a map, and all that is simulated of its flight."""


def shortened(declaration: Declaration) -> Declaration:
    """One seed, the first seconds of every flight at half its rate, small maps, each table's ends.

    Maps that differ in nothing else are then the same. Of cases whose maps are registered by hand,
    each of a building of its own, there is the first; of others the last, too.
    """
    experiments = []
    for experiment in declaration.experiments:
        cases = [
            replace(case, flight=_first_seconds(case.flight), map=_thinned(case.map))
            for k, case in enumerate(experiment.cases)
            if k == 0 or (k == len(experiment.cases) - 1 and not case.map.flight.clicked)
        ]
        experiments.append(replace(experiment, cases=cases))
    return replace(declaration, seeds=declaration.seeds[:1], experiments=experiments)


def _first_seconds(flight: FlightDeclaration) -> FlightDeclaration:
    """Every other frame of its first seconds; of real pictures as many as that is."""
    if flight.simulated:
        seconds = min(flight.duration_s, FLIGHT_S)
        return replace(flight, duration_s=seconds, rate_hz=flight.rate_hz / 2)
    wanted = parse_range(flight.range) if flight.range else FrameRange()
    stop = wanted.start + round(FLIGHT_S * flight.rate_hz) * wanted.step
    stop = stop if wanted.stop is None else min(stop, wanted.stop)
    return replace(flight, range=f"{wanted.start}:{stop}:{2 * wanted.step}")


def _thinned(spec: MapSpec) -> MapSpec:
    """Of few images, and none is simulated that is not among them."""
    if not spec.flight.simulated or spec.flight.clicked:
        return spec
    images = min(spec.images or IMAGES, IMAGES)
    rate_hz = min(spec.flight.rate_hz, images / spec.flight.duration_s)
    return replace(spec, images=images, flight=replace(spec.flight, rate_hz=rate_hz))
