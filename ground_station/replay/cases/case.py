"""A replay test as one TOML file: what is flown, over which link, by which truth and bounds."""

from __future__ import annotations

import dataclasses
import re
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from ground_station.errors import InputError
from ground_station.evaluation.figures import AT_LEAST, AT_MOST
from ground_station.localization.settings import PRESETS
from pi_firmware.wire import config
from pi_firmware.wire.config import key, table
from pi_firmware.wire.recording import TRUTH_TOPIC

PROCESS, IMAGE, SSH = "process", "image", "ssh"
PAYLOADS = (PROCESS, IMAGE, SSH)
"""The firmware on this machine, the flashed image in an emulator, a real board over SSH."""
LOOPBACK, PROXY, NAMESPACE = "loopback", "proxy", "namespace"
LINKS = (LOOPBACK, PROXY, NAMESPACE)
RECORDING, SURVEY, GOLDEN, NONE = "recording", "survey", "golden", "none"
TRUTHS = (RECORDING, SURVEY, GOLDEN, NONE)
MAX_RATE_HZ, MAX_SPAN_S = 120.0, 1e6
"""What the firmware's `replay:` takes."""
_SETTING = re.compile(r"([a-z]\w*(?:\.[a-z]\w*)+)=.*", re.DOTALL | re.ASCII)
_NOT_HERE = re.compile(
    r"camera\.(uri|width_px|height_px)|link\.(host|port|encrypted)|supervision\.state"
    r"|telemetry\..*|.*_command"
)
"""Settings that the run makes itself, and those that would run a program."""


def _bound(doc: str, unit: str, high: float | None = None) -> Any:
    return key(None, doc, unit=unit, low=0.0, high=high)


@dataclass(frozen=True)
class Limits:
    """What a run must hold; what is left out is measured and not judged."""

    coverage_min: float | None = _bound("localized frames, of those sent", "share", 1.0)
    tracking_min: float | None = _bound(
        "frames called TRACKING, of those that reached the localizer", "share", 1.0
    )
    lost_max: float | None = _bound("frames lost, of those sent", "share", 1.0)
    position_rmse_m_max: float | None = _bound("position error, RMSE, unaligned", "m")
    rotation_rmse_deg_max: float | None = _bound("rotation error, RMSE", "°", 180.0)
    position_max_m: float | None = _bound("worst position error of a pose called TRACKING", "m")
    latency_p50_ms_max: float | None = _bound("capture to pose, median", "ms")
    latency_p99_ms_max: float | None = _bound("capture to pose, 99th percentile", "ms")
    recovery_s_max: float | None = _bound(
        "from an outage's end to the first TRACKING pose of a frame taken after it", "s"
    )
    payload_memory_MB_max: float | None = _bound("the firmware's resident memory, peak", "MB")
    ground_memory_MB_max: float | None = _bound("the ground station's resident memory, peak", "MB")
    payload_cpu_max: float | None = _bound(
        "the firmware's processor time, of one core (of a board, from telemetry: of all cores)",
        "share", 64.0,
    )  # fmt: skip
    battery_V_min: float | None = _bound("the cell's voltage, as telemetry says it", "V", 60.0)
    battery_V_max: float | None = _bound("the same, from above", "V", 60.0)
    identical: bool = key(False, "stepped only: a second run gives the same poses, bit for bit")


NAMES = tuple(item.name for item in dataclasses.fields(Limits))
BOUNDS: list[tuple[str, str, str, str]] = [
    (
        item.name,
        "tracking_worst_m" if item.name == "position_max_m" else item.name[: -len("_max")],
        item.metadata["unit"],
        AT_LEAST if item.name.endswith("_min") else AT_MOST,
    )
    for item in dataclasses.fields(Limits)
    if item.name != "identical"
]
"""Of each bound its name, its figure, unit and sense; the figure without the bound's suffix."""


@dataclass(frozen=True)
class KindLimits(Limits):
    """Bounds of one payload kind: each key in place of the same one in [bounds]."""

    drop: list[str] = key([], "bounds of [bounds] that are not judged here", choices=NAMES)


@dataclass(frozen=True)
class Bounds(Limits):
    """The bounds of all payload kinds, and those of emulated and real boards."""

    image: KindLimits = table(KindLimits)
    ssh: KindLimits = table(KindLimits)

    def __post_init__(self) -> None:
        for place, own in (("", self), ("image.", self.image), ("ssh.", self.ssh)):
            low, high = own.battery_V_min, own.battery_V_max
            if low is not None and high is not None and low > high:
                raise ValueError(
                    f"'bounds.{place}battery_V_min' is {low:g} V; allowed: at most battery_V_max,"
                    f" {high:g} V"
                )

    def of(self, kind: str) -> Limits:
        """What is judged on a payload kind."""
        values: dict[str, Any] = {name: getattr(self, name) for name in NAMES}
        own = getattr(self, kind, None)
        if isinstance(own, KindLimits):
            given = {name: getattr(own, name) for name in NAMES}
            # By identity: a bound of 0 is a bound.
            values |= {k: v for k, v in given.items() if v is not None and v is not False}
            values |= {name: False if name == "identical" else None for name in own.drop}
        return Limits(**values)


def _share(doc: str, default: float = 0.0) -> Any:
    return key(default, doc, unit="share", low=0.0, high=1.0)


def _span(default: float | None, doc: str) -> Any:
    return key(default, doc, unit="s", low=0.0, high=MAX_SPAN_S)


_RATE, _START, _STOP = (
    "frames captured a second",
    "begin so far into the recording",
    "stop after so long; 0: at the end",
)


@dataclass(frozen=True)
class Payload:
    """Where the case can be flown, and with which settings of the firmware."""

    kinds: list[str] = key(list(PAYLOADS), "payloads that can fly this case", choices=PAYLOADS)
    settings: list[str] = key(
        [], 'settings of the firmware as its --set takes them, "encoder.bitrate_kbps=800"'
    )

    def __post_init__(self) -> None:
        if not self.kinds:
            raise ValueError(f"'payload.kinds' is empty; allowed: {', '.join(PAYLOADS)}")
        _check_settings(self.settings, "payload.settings")


@dataclass(frozen=True)
class Link:
    """What the video's packets meet on their way; bursts are the Gilbert-Elliott model's."""

    kind: str = key(LOOPBACK, "what carries the video; loopback impairs nothing", choices=LINKS)
    seed: int = key(0, "what happens to the n-th packet follows from it", low=0, high=2**31 - 1)
    loss: float = _share("packets lost, each by itself")
    burst_start: float = _share("probability before each packet that a good link turns bad")
    burst_end: float = _share("probability before each packet that a bad link turns good", 1.0)
    burst_loss: float = _share("packets lost while it is bad", 1.0)
    reorder: float = _share("packets that others overtake")
    reorder_by: int = key(3, "how many overtake", unit="packets", low=1, high=100)
    duplicate: float = _share("packets that come twice")
    delay_s: float = key(0.0, "delay of every packet", unit="s", low=0.0, high=10.0)
    jitter_s: float = key(0.0, "up to this much more, drawn for each", unit="s", low=0.0, high=10.0)
    rate_kbps: float = key(0.0, "what it carries; 0: unlimited", unit="kbit/s", low=0.0, high=1e6)
    queue_s: float = key(
        0.5, "packets that would wait longer for that rate are lost", unit="s", low=0.0, high=10.0
    )
    outages: list[list[float]] = key(
        [], "[at_s, for_s] each, from the first packet on: nothing passes", unit="s", low=0.0,
        high=MAX_SPAN_S,
    )  # fmt: skip

    def __post_init__(self) -> None:
        end_s = 0.0
        for number, outage in enumerate(self.outages):
            what = f"'link.outages[{number}]'"
            if len(outage) != 2:
                raise ValueError(f"{what} has {len(outage)} numbers; it is [at_s, for_s]")
            if outage[1] <= 0:
                raise ValueError(f"{what} lasts {outage[1]:g} s; allowed: more than 0 s")
            if outage[0] < end_s:
                raise ValueError(
                    f"{what} begins at {outage[0]:g} s; allowed: from {end_s:g} s on, where the one"
                    " before it ends"
                )
            end_s = sum(outage)
        if self.kind == LOOPBACK and (changed := self.changed()):
            raise ValueError(
                f"'link.{changed[0]}' is set, but 'link.kind' is 'loopback', which impairs nothing;"
                " allowed: 'proxy', 'namespace'"
            )

    def changed(self) -> list[str]:
        """The names of what it does to packets."""
        usual = asdict(Link(kind=PROXY)) | {"kind": self.kind, "seed": self.seed}
        return [name for name, value in asdict(self).items() if value != usual[name]]


@dataclass(frozen=True)
class Truth:
    """What the poses are held against."""

    kind: str = key(
        NONE,
        "recording: poses in the recording; survey: a TUM file; golden: an accepted run; none",
        choices=TRUTHS,
    )
    file: str = key("", "survey: its TUM text; golden: what `blimp replay --accept` wrote")
    topic: str = key(TRUTH_TOPIC, "recording: the topic of its poses")

    def __post_init__(self) -> None:
        needs = self.kind in (SURVEY, GOLDEN)
        if needs and not self.file:
            raise ValueError(f"the key 'truth.file' is missing; 'truth.kind' is '{self.kind}'")
        if self.file and not needs:
            raise ValueError(f"'truth.file' is set, but 'truth.kind' is '{self.kind}'")
        if not self.topic.startswith("/"):
            raise ValueError(f"'truth.topic' is {self.topic[:60]!r}; a topic begins with /")


@dataclass(frozen=True)
class Flown:
    """How much of the recording a payload kind bears; what is left out is the case's own."""

    rate_hz: float | None = key(None, _RATE, unit="Hz", low=1.0, high=MAX_RATE_HZ)
    start_s: float | None = _span(None, _START)
    duration_s: float | None = _span(None, _STOP)
    settings: list[str] = key([], "more settings of the firmware, after those of [payload]")


@dataclass(frozen=True)
class Kinds:
    """What emulated and real boards fly otherwise."""

    image: Flown = table(Flown)
    ssh: Flown = table(Flown)

    def __post_init__(self) -> None:
        for kind in (IMAGE, SSH):
            _check_settings(getattr(self, kind).settings, f"kinds.{kind}.settings")


@dataclass(frozen=True)
class Keys:
    """Every key of a case file; paths are relative to the file's folder."""

    title: str = field(metadata={"doc": "what the case shows, in one line"})
    recording: str = field(metadata={"doc": "the flight, an .mcap file with its camera in it"})
    map: str = field(metadata={"doc": "the folder of a map"})
    preset: str = key("default", "the localizer's settings", choices=PRESETS)
    init: str = key("none", "the first frame's pose: none, truth (the recording's), or a TUM file")
    rate_hz: float = key(30.0, _RATE, unit="Hz", low=1.0, high=MAX_RATE_HZ)
    start_s: float = _span(0.0, _START)
    duration_s: float = _span(0.0, _STOP)
    stepped: bool = key(
        False, "frames are fed as fast as they are consumed; two runs give the same poses"
    )
    payload: Payload = table(Payload)
    link: Link = table(Link)
    truth: Truth = table(Truth)
    bounds: Bounds = table(Bounds)
    kinds: Kinds = table(Kinds)

    def __post_init__(self) -> None:
        for name in ("title", "recording", "map", "init"):
            text = getattr(self, name)
            if not text.strip() or not text.isprintable() or len(text) > 1000:
                raise ValueError(f"'{name}' is {text[:60]!r}; allowed: one line of text")
        if self.preset == "thesis" and self.init == "none":
            raise ValueError("'init' is 'none'; with the preset 'thesis' allowed: truth, a file")
        asked = (self.bounds.identical, self.bounds.image.identical, self.bounds.ssh.identical)
        if any(asked) and not self.stepped:
            raise ValueError("'bounds.identical' is true; allowed only where 'stepped' is true")


@dataclass(frozen=True)
class Case(Keys):
    """A case as loaded from `path`."""

    path: Path = Path()

    @property
    def name(self) -> str:
        """The file's name without its ending."""
        return self.path.stem

    @property
    def recording_path(self) -> Path:
        return self._beside(self.recording)

    @property
    def map_path(self) -> Path:
        return self._beside(self.map)

    @property
    def truth_path(self) -> Path | None:
        """The survey's or the accepted run's file; None where the truth is in neither."""
        return self._beside(self.truth.file) if self.truth.file else None

    @property
    def first_pose(self) -> str:
        """As `ReplaySettings.init` takes it."""
        return self.init if self.init in ("none", "truth") else str(self._beside(self.init))

    def flown(self, kind: str) -> Flown:
        """Rate, stretch and all settings of the firmware for a payload kind; none is None."""
        own = getattr(self.kinds, kind, Flown())
        chosen = {
            name: getattr(self if getattr(own, name) is None else own, name)
            for name in ("rate_hz", "start_s", "duration_s")
        }
        return Flown(**chosen, settings=[*self.payload.settings, *own.settings])

    def limits(self, kind: str) -> Limits:
        """The bounds of a payload kind."""
        return self.bounds.of(kind)

    def _beside(self, name: str) -> Path:
        return self.path.parent / name


def load_case(path: str | Path) -> Case:
    """Reads a case; raises `ConfigError` or `InputError` with one line naming file, key and range.

    Its recording, map and survey must be there; an accepted run may be still to come.
    """
    path = Path(path)
    keys = config.load(path, Keys)
    case = Case(**{f.name: getattr(keys, f.name) for f in dataclasses.fields(Keys)}, path=path)
    _exists(case, "recording", case.recording_path)
    _exists(case, "map", case.map_path / "map.toml")
    if case.truth.kind == SURVEY:
        _exists(case, "truth.file", case.truth_path)
    if case.init not in ("none", "truth"):
        _exists(case, "init", Path(case.first_pose))
    return case


def _exists(case: Case, name: str, path: Path | None) -> None:
    try:
        there = path is not None and path.is_file()
    except (OSError, ValueError):  # a name that no file can have
        there = False
    if not there:
        raise InputError(f"{case.path}: '{name}': {path}: no such file"[:400])


def _check_settings(settings: list[str], name: str) -> None:
    for number, setting in enumerate(settings):
        what = f"'{name}[{number}]' is {setting[:60]!r}"
        match = _SETTING.fullmatch(setting)
        if match is None:
            raise ValueError(f"{what}; expected table.key=value, as the firmware's --set takes it")
        if _NOT_HERE.fullmatch(match[1]):
            raise ValueError(f"{what}; a case cannot set '{match[1]}'")
