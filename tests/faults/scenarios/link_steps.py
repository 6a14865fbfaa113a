"""What befalls the air between payload and ground."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from impaired_link import Impairment

from scenarios.step import Step

if TYPE_CHECKING:
    from scenarios.world import World


class Impairs(Step):
    """Base of steps that impair the video's link."""

    def impairment(self) -> Impairment:
        """What the link does meanwhile."""
        raise NotImplementedError

    def inject(self, world: World) -> None:
        world.impair(self, self.impairment())

    def mend(self, world: World) -> None:
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

    def impairment(self) -> Impairment:
        return Impairment(delay_s=self.delay_s, jitter_s=self.jitter_s)


@dataclass(frozen=True)
class Reordered(Impairs):
    """A share of the packets is overtaken by those behind."""

    share: float = 0.1
    by: int = 3

    def impairment(self) -> Impairment:
        return Impairment(reorder=self.share, reorder_by=self.by)


@dataclass(frozen=True)
class Duplicated(Impairs):
    """A share of the packets comes twice."""

    share: float = 0.2

    def impairment(self) -> Impairment:
        return Impairment(duplicate=self.share)


@dataclass(frozen=True)
class Outage(Step):
    """No video at all; telemetry, too, with `telemetry`."""

    telemetry: bool = False

    def inject(self, world: World) -> None:
        world.link.gone(self.for_s)
        if self.telemetry:
            world.wire.block(self)

    def mend(self, world: World) -> None:
        if self.telemetry:
            world.wire.mend(self)


@dataclass(frozen=True)
class TelemetryCut(Step):
    """The payload's Zenoh session is reset, and cannot come back meanwhile."""

    def inject(self, world: World) -> None:
        world.wire.cut(self)

    def mend(self, world: World) -> None:
        world.wire.mend(self)


@dataclass(frozen=True)
class TelemetryBlocked(Step):
    """Its connection stays, and nothing comes through in either direction."""

    def inject(self, world: World) -> None:
        world.wire.block(self)

    def mend(self, world: World) -> None:
        world.wire.mend(self)
