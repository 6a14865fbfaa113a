"""What of the program a result depends on: a hash of rooms' code that comments do not change."""

from __future__ import annotations

import ast
import functools
import hashlib
from pathlib import Path

_ROOT = Path(__file__).resolve().parents[1]

ROOMS = {
    "flight": ("experiments/flights.py", "simulator", "geometry"),
    "map": ("experiments/maps.py", "experiments/material.py", "map", "mapping", "features",
            "geometry", "recording"),
    "run": ("experiments/measure.py", "experiments/alone.py", "experiments/alter.py",
            "experiments/maps.py", "experiments/material.py",
            "evaluation/ate.py", "localization", "map/store.py", "map/descriptors.py",
            "map/accuracy.py", "map/uncertainty.py", "experiments/thinning.py",
            "features", "geometry", "recording"),
}  # fmt: skip
"""By kind of result, what makes it, below this package."""


@functools.cache
def code_sha256(kind: str) -> str:
    """Of the code that makes results of that kind: its syntax trees and TOML files, by name."""
    whole = hashlib.sha256()
    for room in ROOMS[kind]:
        path = _ROOT / room
        files = sorted(path.rglob("*")) if path.is_dir() else [path]
        for file in files:
            if file.suffix == ".py":
                whole.update(f"{file.relative_to(_ROOT)}\0{_meaning(file.read_text())}\n".encode())
            elif file.suffix == ".toml":
                whole.update(f"{file.relative_to(_ROOT)}\0".encode() + file.read_bytes())
    return whole.hexdigest()


def _meaning(source: str) -> str:
    """A module without comments, layout and docstrings."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            # Attributes' docs are bare strings, too.
            node.body = [s for s in body if not _is_text(s)]  # type: ignore[attr-defined]
    return ast.dump(tree)


def _is_text(statement: ast.AST) -> bool:
    return (
        isinstance(statement, ast.Expr)
        and isinstance(statement.value, ast.Constant)
        and isinstance(statement.value.value, str)
    )
