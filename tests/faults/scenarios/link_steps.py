"""What befalls the air between payload and ground."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from impaired_link import Impairment

from scenarios.step import Step

if TYPE_CHECKING:
    from scenarios.world import World


class Impairs(Step):
    """Base of steps that impair the video's link; `COUNT` is the count of it that then grows."""

    COUNT: ClassVar[str] = "lost"

    def impairment(self) -> Impairment:
        """What the link does meanwhile."""
        raise NotImplementedError

    def inject(self, world: World) -> None:
        world.kept[id(self)] = getattr(world.link.counts, self.COUNT)
        world.impair(self, self.impairment())

    def lacking(self, world: World) -> str:
        grown = getattr(world.link.counts, self.COUNT) > world.kept[id(self)]
        return "" if grown else f"no packet was {self.COUNT}"

    def fix(self, world: World) -> None:
        world.impair(self, None)


@dataclass(frozen=True)
class Loss(Impairs):
    """A share of the packets, each by chance."""

    share: float = 0.05

    def impairment(self) -> Impairment:
        return Impairment(loss=self.share)


@dataclass(frozen=True)
class Bursts(Impairs):
    """Some ten packets in a row, again and again (Gilbert-Elliott)."""

    share: float = 0.02

    def impairment(self) -> Impairment:
        return Impairment(burst_start=self.share, burst_end=0.1)


@dataclass(frozen=True)
class Late(Impairs):
    """Packets are delayed, each by another time, so that they overtake one another, too."""

    delay_s: float = 0.1
    jitter_s: float = 0.05
    COUNT: ClassVar[str] = "delayed"

    def impairment(self) -> Impairment:
        return Impairment(delay_s=self.delay_s, jitter_s=self.jitter_s)


@dataclass(frozen=True)
class Reordered(Impairs):
    """A share of the packets is overtaken by those behind."""

    share: float = 0.1
    by: int = 3
    COUNT: ClassVar[str] = "delayed"

    def impairment(self) -> Impairment:
        return Impairment(reorder=self.share, reorder_by=self.by)


@dataclass(frozen=True)
class Duplicated(Impairs):
    """A share of the packets comes twice."""

    share: float = 0.2
    COUNT: ClassVar[str] = "duplicated"

    def impairment(self) -> Impairment:
        return Impairment(duplicate=self.share)


@dataclass(frozen=True)
class Outage(Step):
    """No video at all; telemetry, too, with `telemetry`."""

    telemetry: bool = False

    def inject(self, world: World) -> None:
        world.kept[id(self)] = world.link.counts.lost
        world.link.gone(self.for_s)
        if self.telemetry:
            world.wire.block(self)

    def lacking(self, world: World) -> str:
        return "" if world.link.counts.lost > world.kept[id(self)] else "no packet was lost"

    def fix(self, world: World) -> None:
        if self.telemetry:
            world.wire.fix(self)


class Silences(Step):
    """Base of steps in which telemetry does not come through."""

    def inject(self, world: World) -> None:
        world.kept[id(self)] = world.heard_up_to_s()

    def lacking(self, world: World) -> str:
        heard_s = world.heard_up_to_s() - world.kept[id(self)]
        return f"{heard_s:.1f} s more of health were heard" if heard_s > self.for_s / 2 else ""

    def fix(self, world: World) -> None:
        world.wire.fix(self)


@dataclass(frozen=True)
class TelemetryCut(Silences):
    """The payload's Zenoh session is reset, and cannot come back meanwhile."""

    def inject(self, world: World) -> None:
        super().inject(world)
        world.wire.cut(self)


@dataclass(frozen=True)
class TelemetryBlocked(Silences):
    """Its connection stays, and nothing comes through in either direction."""

    def inject(self, world: World) -> None:
        super().inject(world)
        world.wire.block(self)
