"""What is flown, mapped and compared: `experiments.toml` as checked, plain values."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from ground_station.errors import InputError
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
    lens_error: float = config.key(
        0.0, "share by which the focal length that is known is off", low=-0.2, high=0.2
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
class Alteration:
    """What happens to a flight's frames before they are localized, and to the map they meet."""

    every: int = config.key(1, "one frame in so many is seen", unit="frames", low=1, high=100)
    scale: float = config.key(1.0, "side of the picture over the flight's", low=0.1, high=1.0)
    blur_px: float = config.key(
        0.0, "standard deviation of a Gaussian blur", unit="px", low=0.0, high=50.0
    )
    packet_loss: float = config.key(
        0.0,
        "share of the video's packets lost; what needs them is not seen",
        low=0.0,
        high=1.0,
    )
    dark_from_s: float = config.key(
        0.0, "the lens is covered from then on", unit="s", low=0.0, high=3600
    )
    dark_s: float = config.key(0.0, "for so long; 0: never", unit="s", low=0.0, high=3600)
    landmarks: float = config.key(
        1.0, "share of the map's landmarks that is there, drawn at random", low=0.01, high=1.0
    )


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
class Case:
    """One row: a map, a flight and settings; each preset localizes it, once for each seed."""

    experiment: str
    name: str
    title: str
    map: MapSpec
    flight: FlightDeclaration
    alter: Alteration
    localizer: Table
    presets: tuple[str, ...]
    thesis: Figures


@dataclass(frozen=True)
class Experiment:
    """A table: `level` names what its cases vary, where that is a number."""

    name: str
    title: str
    question: str
    thesis: str
    level: str
    times: Times
    cases: list[Case] = field(default_factory=list)


@dataclass(frozen=True)
class Declaration:
    """All experiments, the seeds of their flights, and what is claimed of those that are wanted."""

    seeds: tuple[int, ...]
    experiments: list[Experiment]
    claims: list[Claim] = field(default_factory=list)


@dataclass(frozen=True)
class _Row:
    """What an experiment, or a case of it on top, may say."""

    title: str = config.key("", "as shown")
    question: str = config.key("", "what is asked")
    thesis_source: str = config.key("", "where the thesis has its figures")
    thesis_times: Times = config.table(Times)
    level: str = config.key("", "what the cases vary")
    presets: list[str] = config.key(list(PRESETS), "which of the localizer's", choices=None)
    map: MapSpec = config.table(MapSpec)
    flight: FlightDeclaration = config.table(FlightDeclaration)
    alter: Alteration = config.table(Alteration)
    thesis: Figures = config.table(Figures)


def load(path: str | Path = SHIPPED, only: list[str] | None = None) -> Declaration:
    """Reads experiments; `only` names those wanted. Raises `ConfigError` or `InputError`.

    What stands under `[default]` holds for every case unless its experiment or itself says
    otherwise; a map flies as its case does unless `map.flight` says otherwise.
    """
    document = config.read(path)
    where = str(path)
    for key in sorted(set(document) - _TOP):
        known = ", ".join(sorted(_TOP))
        raise ConfigError(f"{where}: unknown key '{key}' (known here: {known})")
    seeds = document.get("seeds", [1, 2, 3, 4, 5])
    if not (
        isinstance(seeds, list)
        and seeds
        and all(type(seed) is int and 0 <= seed < 2**31 for seed in seeds)
        and len(set(seeds)) == len(seeds)
    ):
        raise ConfigError(f"{where}: 'seeds' must be a list of different whole numbers")
    declared = _table(document, "experiment", where)
    names = list(declared) if only is None else only
    for name in names:
        if name not in declared:
            known = ", ".join(declared)
            raise InputError(f"there is no experiment '{name:.60}' (there are: {known})")
    default = _table(document, "default", where)
    experiments = [_experiment(name, declared[name], default, where) for name in names]
    claims = _claims(_table(document, "claim", where), declared, where)
    return Declaration(tuple(seeds), experiments, claims)


_TOP = {"seeds", "default", "experiment", "claim"}


def _claims(tables: Table, declared: Table, where: str) -> list[Claim]:
    """Claims in the order of the file; raises `ConfigError` for one of a row that is not there."""
    found = []
    for name, table in tables.items():
        at = f"{where}: claim '{name}'"
        if not isinstance(table, Mapping):
            raise ConfigError(f"{at} must be a table")
        claim = config.from_mapping(table, Claim, where=at)
        for key, row in (("row", claim.row), ("against", claim.against)):
            experiment, dot, case = row.partition(".")
            known = case in _table(_table(declared, experiment, where), "case", where)
            known |= bool(row) and not dot and experiment in declared
            if (row or key == "row") and not known:
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


def _experiment(name: str, table: Any, default: Table, where: str) -> Experiment:
    where = f"{where}: experiment '{name}'"
    if not isinstance(table, Mapping):
        raise ConfigError(f"{where} must be a table")
    cases = _table(table, "case", where) or {"": {}}
    own = {key: value for key, value in table.items() if key != "case"}
    base = merged(default, own)
    head = config.from_mapping(_without_localizer(base), _Row, where=where)
    experiment = Experiment(
        name, head.title or name, head.question, head.thesis_source, head.level, head.thesis_times
    )
    for case, changes in cases.items():
        if not isinstance(changes, Mapping):
            raise ConfigError(f"{where}, case '{case}' must be a table")
        experiment.cases.append(_case(experiment, case, merged(base, changes), changes, where))
    return experiment


def _case(experiment: Experiment, name: str, whole: Table, changes: Table, where: str) -> Case:
    where = f"{where}, case '{name}'"
    mapped = dict(_table(whole, "map", where))
    # A map is of the case's own surroundings, but not of its alterations, bit rate or pace.
    flown = {k: v for k, v in _table(whole, "flight", where).items() if k in _OF_THE_PLACE}
    mapped["flight"] = merged(flown, _table(mapped, "flight", where))
    document = _without_localizer(whole) | {"map": mapped}
    row = config.from_mapping(document, _Row, where=where)
    unknown = [preset for preset in row.presets if preset not in PRESETS]
    if unknown:
        raise ConfigError(
            f"{where}: 'presets' names '{unknown[0]:.60}'; allowed: {', '.join(PRESETS)}"
        )
    return Case(
        experiment=experiment.name,
        name=name,
        title=str(changes.get("title", "")) or name or experiment.title,
        map=row.map,
        flight=row.flight,
        alter=row.alter,
        localizer=_table(whole, "localizer", where),
        presets=tuple(preset for preset in PRESETS if preset in row.presets),
        thesis=row.thesis,
    )


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


def _without_localizer(document: Table) -> dict[str, Any]:
    """The localizer's keys are checked by its own settings, when a preset is known."""
    return {key: value for key, value in document.items() if key != "localizer"}
