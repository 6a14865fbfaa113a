"""What a fault is: data with a time, that knows how to inject itself and how to fix it again."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

if TYPE_CHECKING:
    from scenarios.world import World

KINDS: dict[str, type[Step]] = {}
"""All steps by name."""


class StepError(Exception):
    """A document that is no step, in one line."""


@dataclass(frozen=True)
class Step:
    """A fault from `at_s` on, seconds after the flight is tracked, for `for_s` seconds.

    `inject` and `fix` are called once each and find whatever other steps have left: a process that
    they want to stop may be gone already.
    """

    at_s: float
    for_s: float

    STARTS: ClassVar[bool] = False
    """Whether a process restarts, so that recovery takes its start, too."""

    def __init_subclass__(cls) -> None:
        KINDS[cls.__name__] = cls

    @property
    def until_s(self) -> float:
        """When it is repaired."""
        return self.at_s + self.for_s

    def inject(self, world: World) -> None:
        """Begins the fault."""
        raise NotImplementedError

    def lacking(self, world: World) -> str:
        """What of the fault cannot be seen at its end, before its repair; '' where it was one."""
        raise NotImplementedError

    def fix(self, world: World) -> None:
        """Ends it; nothing to do for what fixes itself."""

    def __str__(self) -> str:
        own = [
            f"{field.name}={getattr(self, field.name)!r}"
            for field in dataclasses.fields(self)[2:]
            if getattr(self, field.name) != field.default
        ]
        what = f"{type(self).__name__}({', '.join(own)})"
        return f"{self.at_s:g} s: {what}" + (f" for {self.for_s:g} s" if self.for_s else "")


@dataclass(frozen=True)
class Scenario:
    """Steps that befall one flight. `disk_MB` is the size of the recordings' disk, 0: no own."""

    name: str
    steps: tuple[Step, ...]
    disk_MB: int = 0
    foxglove: bool = False

    def alone(self, step: Step) -> bool:
        """Whether no other fault befalls the flight meanwhile, whose traces it would blur."""
        return all(
            other is step or other.until_s < step.at_s or step.until_s < other.at_s
            for other in self.steps
        )

    @property
    def until_s(self) -> float:
        """When the last fault is repaired."""
        return max((step.until_s for step in self.steps), default=0.0)

    @property
    def starts(self) -> bool:
        """Whether a process restarts on the way."""
        return any(step.STARTS for step in self.steps)


def as_json(scenario: Scenario) -> str:
    """The scenario as text from which it can be run again."""
    steps = [{"step": type(step).__name__, **dataclasses.asdict(step)} for step in scenario.steps]
    lines = ",\n  ".join(json.dumps(step) for step in steps)
    rest = {"disk_MB": scenario.disk_MB, "foxglove": scenario.foxglove}
    head = json.dumps({"name": scenario.name, **rest})[:-1]
    return f'{head}, "steps": [\n  {lines}\n]}}\n'


def from_json(text: str) -> Scenario:
    """The scenario that `as_json` wrote; raises `StepError` with one line."""
    try:
        document = json.loads(text)
        steps = tuple(_step(item) for item in document.pop("steps"))
        return Scenario(steps=steps, **document)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise StepError(f"no scenario: {str(error)[:120]}") from None


def _step(document: dict[str, Any]) -> Step:
    given = dict(document)
    kind = KINDS.get(name := str(given.pop("step")))
    if kind is None:
        raise StepError(f"no step '{name[:40]}' (there are: {', '.join(sorted(KINDS))})")
    step = kind(**given)
    for value in (step.at_s, step.for_s):
        if not (isinstance(value, int | float) and math.isfinite(value) and 0 <= value <= 3600):
            raise StepError(f"{name}: {value!r:.20} s is not between 0 and 3600")
    return step
