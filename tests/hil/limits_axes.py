"""What the system is tried against, and the search for how much of it is borne.

An axis is a list of levels from no burden to too much; the highest that is sustained is looked for
without trusting monotony.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

RATE_HZ = 30.0
ADAPTING = ("encoder.adapt=true",)
"""As the payload flies: bit rate and IDR interval follow what the ground reports."""
ALONE = ("link.history_s=0", "link.assumed_loss=0.02")
"""A link that is one way: nothing is sent again, and correction does not wait for reports."""
UNRECOVERED = ("link.history_s=0", "link.correction=0")
"""A payload of 0.1."""
BURST_PACKETS = 10.0
"""The mean length of a burst in which all packets are lost."""
QUEUE_S = 0.5
"""What a slow link keeps waiting before it throws packets away."""


@dataclass(frozen=True)
class Conditions:
    """What one trial is under.

    `impairment` are the fields of the link's `Impairment`; empty: no link is between. `payload` are
    settings of the firmware. Cores of 0 are not limited. `payloads` of 0 is one flight with
    `blimp replay`'s own loop; from 1 on it is the whole service with so many.
    """

    impairment: Mapping[str, float] = field(default_factory=dict)
    payload: tuple[str, ...] = ()
    ground_cores: float = 0.0
    payload_cores: float = 0.0
    payloads: int = 0
    rate_hz: float = RATE_HZ


@dataclass(frozen=True)
class Level:
    """One level, as a person reads it."""

    text: str
    under: Conditions


@dataclass(frozen=True)
class Axis:
    """One kind of burden; the first level is without it."""

    name: str
    title: str
    levels: tuple[Level, ...]


def _link(text: str, *settings: str, **impairment: float) -> Level:
    return Level(text, Conditions(impairment, (*ADAPTING, *settings)))


def _percent(share: float) -> str:
    return f"{100 * share:g} %"


def _seconds(value_s: float) -> str:
    return f"{1000 * value_s:g} ms" if value_s < 1 else f"{value_s:g} s"


def _burst(share: float) -> Level:
    """Bursts that take this share of the packets: p/(p + r) of the Gilbert-Elliott model."""
    end = 1.0 / BURST_PACKETS
    return _link(_percent(share), burst_start=end * share / (1.0 - share), burst_end=end)


def _service(payloads: int, rate_hz: float) -> Level:
    return Level(str(payloads), Conditions(payloads=payloads, rate_hz=rate_hz))


def _bitrate(kbps: int) -> Level:
    least = min(kbps, 300)  # of what it may adapt to, which must not be above
    settings = (
        "encoder.adapt=false",
        f"encoder.bitrate_kbps={kbps}",
        f"encoder.min_bitrate_kbps={least}",
    )
    return Level(f"{kbps} kbit/s", Conditions(payload=settings))


_SHARES = (0.001, 0.002, 0.005, 0.01, 0.02, 0.03, 0.05, 0.1, 0.2)
_DELAYS_S = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
_JITTERS_S = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2)
_LINK_KBPS = (5000, 4000, 3000, 2500, 2000, 1500, 1000, 700, 500, 300, 200)
_ENCODER_KBPS = (2000, 1500, 1000, 700, 500, 300, 200, 150, 100)
_CORES = (1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1)
_FREE = Level("all", Conditions())

AXES = (
    Axis("loss", "packets lost, one by one", (
        _link("none"), *(_link(_percent(share), loss=share) for share in _SHARES))),
    Axis("loss-one-way", "packets lost, one by one; nothing is sent again", (
        _link("none", *ALONE), *(_link(_percent(share), *ALONE, loss=share) for share in _SHARES))),
    Axis("loss-unrecovered", "packets lost, one by one; nothing is sent again or corrected", (
        _link("none", *UNRECOVERED),
        *(_link(_percent(share), *UNRECOVERED, loss=share) for share in _SHARES))),
    Axis("bursts", f"packets lost, in bursts of {BURST_PACKETS:g}", (
        _link("none"), *(_burst(share) for share in _SHARES))),
    Axis("latency", "delay of each packet", (
        _link("none"), *(_link(_seconds(delay), delay_s=delay) for delay in _DELAYS_S))),
    Axis("jitter", "jitter: delay drawn up to this for each packet, so they overtake", (
        _link("none"), *(_link(_seconds(jitter), jitter_s=jitter) for jitter in _JITTERS_S))),
    Axis("rate", f"the link's bit rate, with a queue of {QUEUE_S:g} s", (
        _link("any"), *(_link(f"{kbps} kbit/s", rate_kbps=kbps, queue_s=QUEUE_S)
                        for kbps in _LINK_KBPS))),
    Axis("bitrate", "the encoder's bit rate", tuple(_bitrate(kbps) for kbps in _ENCODER_KBPS)),
    Axis("ground-cpu", "receiver and localizer have this much of a core", (
        _FREE, *(Level(f"{cores:g}", Conditions(ground_cores=cores)) for cores in _CORES))),
    Axis("payload-cpu", "the firmware has this much of a core of this machine (x264)", (
        _FREE, *(Level(f"{cores:g}", Conditions(payload_cores=cores)) for cores in _CORES))),
    Axis("payloads", "payloads at 30 Hz, firmware and service on this machine", tuple(
        _service(payloads, 30.0) for payloads in range(1, 9))),
    Axis("payloads-10hz", "payloads at 10 Hz, firmware and service on this machine", tuple(
        _service(payloads, 10.0) for payloads in range(1, 13))),
)  # fmt: skip


def chosen(names: Sequence[str]) -> list[Axis]:
    """The axes of these names, all without any; raises `ValueError` for another name."""
    known = {axis.name: axis for axis in AXES}
    for name in names:
        if name not in known:
            raise ValueError(f"--only {name!r}: not one of {', '.join(known)}")
    return [axis for axis in AXES if not names or axis.name in names]


BORNE = 0.95
"""The share of TRACKING frames that each seed must keep."""


@dataclass(frozen=True)
class Tried:
    """One level's shares of TRACKING, one for each seed."""

    shares: tuple[float, ...]

    @property
    def sustained(self) -> bool:
        """Whether all seeds keep the share; NaN keeps nothing."""
        return bool(self.shares) and all(share >= BORNE for share in self.shares)


@dataclass
class Found:
    """What a search knows: levels by their place in the list, 0 the easiest.

    `sustained` is the highest level up to which every tried one is so, None when not even the first
    is; `refused` the next one that is not, None when there is no harder level. `odd` are tried
    levels above a refused one that are sustained all the same: there the answer is not monotonic.
    """

    tried: dict[int, Tried] = field(default_factory=dict)

    @property
    def refused(self) -> int | None:
        return min((n for n, one in self.tried.items() if not one.sustained), default=None)

    @property
    def sustained(self) -> int | None:
        refused = self.refused
        below = [n for n in self.tried if refused is None or n < refused]
        return max(below, default=None)

    @property
    def odd(self) -> list[int]:
        refused = self.refused
        if refused is None:
            return []
        return sorted(n for n, one in self.tried.items() if n > refused and one.sustained)


def search(levels: int, measure: Callable[[int], Sequence[float]], found: Found) -> Found:
    """Brackets the limit among `levels` levels, easiest first, and looks at both its sides.

    `measure` gives a level's shares by seed. Level 0 comes first: when it is refused, nothing is
    said of the others. Then the list is halved until the highest level sustained and the lowest one
    refused are neighbours. One level beyond and one below are tried as well; should the one below
    fail, the search goes on beneath it. What `found` has already is not measured again, and it is
    filled as the search goes, so that an interruption keeps it.
    """

    def holds(level: int) -> bool:
        if level not in found.tried:
            found.tried[level] = Tried(tuple(measure(level)))
        return found.tried[level].sustained

    if levels < 1 or not holds(0):
        return found
    low, high = 0, levels  # `low` is sustained; `high` is refused, or beyond the list
    while True:
        while high - low > 1:
            middle = (low + high) // 2
            if holds(middle):
                low = middle
            else:
                high = middle
        if high + 1 < levels:
            holds(high + 1)
        if low < 2 or holds(low - 1):
            return found
        low, high = 0, low - 1
