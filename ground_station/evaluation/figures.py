"""A measured figure, the bound that it is held to, and both in words."""

from __future__ import annotations

import math
from dataclasses import dataclass
from decimal import Decimal

AT_MOST, AT_LEAST, EXACTLY = "at most", "at least", "exactly"


@dataclass(frozen=True)
class Row:
    """One figure and what became of it.

    `bound` is what it was held against, `sense` from which side. `holds` is None where nothing was
    asked. `told` says what it was taken from, or why it could not be.
    """

    name: str
    value: float | None
    unit: str
    bound: float | None = None
    holds: bool | None = None
    sense: str = AT_MOST
    told: str = ""

    @property
    def measured(self) -> str:
        """The value for a person, with digits enough to be on its side of the bound."""
        if self.value is None:
            return "not measured" if self.unit else ""
        return f"{digits(self.value, self.bound)} {self.unit}".strip()

    @property
    def allowed(self) -> str:
        """What was asked, for a person; "" for nothing or a plain condition."""
        if self.bound is None:
            return ""
        return f"{self.sense} {number(self.bound)} {self.unit}".strip()

    @classmethod
    def bounded(
        cls,
        name: str,
        value: float | None,
        unit: str,
        bound: float,
        sense: str = AT_MOST,
        told: str = "",
    ) -> Row:
        """A figure that is held to a bound."""
        return cls(name, value, unit, bound, holds_at(value, bound, sense), sense, told)


def holds_at(value: float | None, bound: float, sense: str) -> bool:
    """Whether a value is on the right side, or on the bound; never for None and NaN."""
    if value is None or math.isnan(value):
        return False
    return value <= bound if sense == AT_MOST else value >= bound


def digits(value: float, bound: float | None) -> str:
    """A number in four digits, or in as many as leave it on its own side of the bound."""
    for count in range(4, 17):
        text = f"{value:.{count}g}"
        shown = float(text)
        if 1e4 <= abs(shown) < 1e15:
            text = format(Decimal(text), "f")
        if bound is None or (shown < bound, shown > bound) == (value < bound, value > bound):
            return text
    return repr(value)


def number(value: float) -> str:
    """A number as a person wrote it."""
    text = f"{value:g}"
    return text if float(text) == value else repr(value)
