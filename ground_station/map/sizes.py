"""How many bytes the parts of a map are."""

from __future__ import annotations

from pathlib import Path

PARTS = {
    "landmarks": ("landmarks.safetensors",),
    "keyframes": ("keyframes.safetensors",),
    "sparse": ("sparse",),
    "other": ("map.toml", "floorplan.png", "floorplan.yaml"),
}
"""What a map's folder holds of it, by part. Recordings that lie beside it are not of it."""


def sizes(folder: str | Path) -> dict[str, int]:
    """The bytes of each part and in all (`total`) of a map on disk."""
    whole = Path(folder)
    found = {part: sum(_bytes(whole / name) for name in names) for part, names in PARTS.items()}
    return found | {"total": sum(found.values())}


def _bytes(path: Path) -> int:
    if path.is_dir():
        return sum(entry.stat().st_size for entry in path.rglob("*") if entry.is_file())
    return path.stat().st_size if path.is_file() else 0
