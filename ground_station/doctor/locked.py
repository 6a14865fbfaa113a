"""What `requirements.lock` asks for: which versions here, and which of them the programs need.

python -m ground_station.doctor.locked     prints the lock without its development part
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import re
import sys
import tomllib
from collections.abc import Iterable, Iterator

from packaging.markers import Marker
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from ground_station.doctor import ROOT

_PINNED = re.compile(r"([A-Za-z0-9][A-Za-z0-9._-]*)==([^\s;\\]+)\s*(?:;([^\\\n]*))?")


def versions(lock: str) -> dict[str, str]:
    """The version of each package that is locked for this Python."""
    return {
        name: version
        for name, version, marker, _ in _entries(lock)
        if not marker or Marker(marker).evaluate()
    }


def _entries(lock: str) -> Iterator[tuple[str, str, str, str]]:
    """Name, version, marker and whole text, hashes and all, of each entry, for any Python."""
    for text in re.split(r"^(?=[A-Za-z0-9])", lock, flags=re.M):
        if (match := _PINNED.match(text)) is not None:
            yield str(canonicalize_name(match[1])), match[2], (match[3] or "").strip(), text


def direct(project: str) -> list[Requirement]:
    """What `pyproject.toml` says that the programs import."""
    table = tomllib.loads(project)["project"]
    return [Requirement(text) for text in table["dependencies"]]


def closure(roots: Iterable[Requirement]) -> set[str]:
    """The roots and all that they need in turn, as this environment's metadata tells it."""
    known: dict[str, set[str]] = {}
    todo = list(roots)
    while todo:
        requirement = todo.pop()
        name = str(canonicalize_name(requirement.name))
        extras = {"", *requirement.extras}
        if extras <= known.get(name, set()):
            continue
        known.setdefault(name, set()).update(extras)
        try:
            needs = importlib.metadata.requires(name) or []
        except importlib.metadata.PackageNotFoundError:
            continue
        for text in needs:
            need = Requirement(text)
            if need.marker is None or any(need.marker.evaluate({"extra": e}) for e in extras):
                todo.append(need)
    return set(known)


def modules(names: Iterable[str]) -> list[str]:
    """What can be imported of the distributions of these names, sorted.

    Left out are private modules, name spaces, and what a distribution lists and does not bring,
    unless it brings nothing else.
    """
    brought: dict[str, list[str]] = {str(name): [] for name in names}
    for module, distributions in importlib.metadata.packages_distributions().items():
        for name in {str(canonicalize_name(d)) for d in distributions} & set(brought):
            if not module.startswith("_"):
                brought[name].append(module)
    chosen: set[str] = set()
    for found in brought.values():
        whole = [module for module in found if _origin(module)]
        chosen.update(whole or found)
    return sorted(chosen)


def _origin(module: str) -> str | None:
    spec = importlib.util.find_spec(module)
    return spec.origin if spec else None


def main() -> int:
    """Prints the part of the lock that the programs need, markers and hashes and all."""
    wanted = closure(direct((ROOT / "pyproject.toml").read_text()))
    lock = (ROOT / "requirements.lock").read_text()
    print("".join(text for name, _, _, text in _entries(lock) if name in wanted), end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
