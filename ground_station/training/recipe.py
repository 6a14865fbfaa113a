"""The recipe as numbers: what is trained on, for how long, with what step."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from ground_station.training.corpus import CorpusSettings
from ground_station.training.errors import TrainingError
from ground_station.training.topology import shape_of

_LENGTHS = ("steps", "decay", "warm_up")
"""When what begins and ends: a run may be made longer or shorter while it goes."""


@dataclass(frozen=True)
class Recipe:
    """Everything that decides the weights, but for the machine's rounding."""

    size: str = "lark"
    seed: int = 1
    corpus: CorpusSettings = field(default_factory=CorpusSettings)
    textures: int = 4096
    """Pictures without a room that there are at one time, the oldest going first."""
    first_textures: int = 512
    fresh: int = 2
    """New ones a step."""
    rows: int = 240
    columns: int = 320
    batch: int = 64
    """Pairs a step."""
    points: int = 256
    """Pairs of points a pair of views, for the descriptors."""
    steps: int = 3_200
    warm_up: int = 200
    decay: int = 1_100
    """The last so many steps, over which the rate goes to nought."""
    rate: float = 3e-3
    weight_decay: float = 1e-4
    average: float = 0.999
    """Of the weights that are exported: what each step leaves of the mean so far."""

    def __post_init__(self) -> None:
        """Raises `TrainingError` with one line for a number that trains nothing."""
        shape_of(self.size)
        limits: dict[str, tuple[float, float]] = {
            "seed": (0, 2**31),
            "textures": (16, 10**6),
            "first_textures": (16, 10**6),
            "fresh": (0, 10**4),
            "rows": (64, 2048),
            "columns": (64, 2048),
            "batch": (1, 4096),
            "points": (16, 2048),
            "steps": (1, 10_000_000),
            "warm_up": (0, self.steps),
            "decay": (0, self.steps),
            "rate": (1e-7, 1.0),
            "weight_decay": (0, 1),
            "average": (0, 0.99999),
        }
        for name, (low, high) in limits.items():
            if not low <= getattr(self, name) <= high:  # nor NaN
                raise TrainingError(
                    f"{name} is {getattr(self, name)}; allowed: {low:g} to {high:g}"
                )
        if self.rows % 16 or self.columns % 16:
            raise TrainingError(
                f"views of {self.columns}x{self.rows}; both must be multiples of 16"
            )
        if self.rows > self.corpus.rows or self.columns > self.corpus.columns:
            raise TrainingError(
                f"views of {self.columns}x{self.rows} are larger than the corpus' pictures"
            )

    def rate_at(self, step: int) -> float:
        """The step size of a step: up in a line, constant, down in a line to nought.

        A constant rate lets the decay branch off anywhere (Hägele et al., NeurIPS 2024).
        """
        up = min(1.0, (step + 1) / self.warm_up) if self.warm_up else 1.0
        left = (self.steps - step) / (self.decay + 1)
        return self.rate * min(up, left, 1.0)

    def decaying_from(self, step: int) -> Recipe:
        """The same until `step`; from there the rate goes down over `decay` steps."""
        return replace(self, steps=step + self.decay, warm_up=min(self.warm_up, step))

    def as_long_as(self, other: dict[str, Any]) -> Recipe:
        """The same for as many steps as another recipe, with its beginning and end."""
        steps, decay, warm_up = (int(other.get(k, getattr(self, k))) for k in _LENGTHS)
        return replace(self, steps=steps, decay=decay, warm_up=warm_up)

    def as_dict(self) -> dict[str, Any]:
        """For checkpoint and log."""
        return asdict(self)

    def differences(self, other: dict[str, Any]) -> list[str]:
        """What of another recipe is not as here, but for the length, which may be changed."""
        mine = self.as_dict()
        free = {*_LENGTHS, "corpus"}
        result = [k for k in mine if k not in free and mine[k] != other.get(k)]
        corpus = other.get("corpus")
        fixed = self.corpus.fixed()
        if not isinstance(corpus, dict) or any(corpus.get(k) != v for k, v in fixed.items()):
            result.append("corpus")
        return result


def is_due(step: int, every: int, last: int) -> bool:
    """Whether something that happens each `every` steps, and at the last, happens after `step`."""
    return step % every == 0 or step == last


def finite(value: float) -> float:
    """A loss as it is logged; raises `TrainingError` where training has run away."""
    if not math.isfinite(value):
        raise TrainingError("the loss is not finite; --resume goes back to the last checkpoint")
    return value
