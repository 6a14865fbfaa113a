"""Models by name: those that ship, and the user's own folder."""

from __future__ import annotations

import os
from pathlib import Path

from ground_station import user_folders
from ground_station.features import model_info
from ground_station.features.extractor import FeatureError
from ground_station.features.model_info import Model

SHIPPED = Path(__file__).with_name("models")
_ENDING = ".onnx"


def users() -> Path:
    """The user's models: `$BLIMP_MODELS`, else `blimp/models` where XDG keeps a user's data."""
    if chosen := os.environ.get("BLIMP_MODELS"):
        return Path(chosen)
    return user_folders.data() / "models"


def path_for(name: str) -> Path:
    """Where a user's model of that name belongs; raises `FeatureError` for what is no name."""
    model_info.check_name(name)
    return users() / f"{name}{_ENDING}"


def names() -> list[str]:
    """The names of all models, those of files: nothing is read."""
    return sorted({path.stem for folder in (SHIPPED, users()) for path in _files(folder)})


def find(name: str) -> Model:
    """The model of that name, read and checked.

    Raises `FeatureError` with one line: there is none, there are two that differ, the file is
    called otherwise than the model in it, or it is none (see `inspection.read`).
    """
    from ground_station.features import inspection  # with onnx, which only models need

    found = [path for folder in (SHIPPED, users()) for path in _files(folder) if path.stem == name]
    if not found:
        known = ", ".join(names()) or "none"
        raise FeatureError(
            f"features: there is no model '{name:.80}' (known: {known});"
            " blimp models import FILE brings one"
        )
    models = [inspection.read(path) for path in found]
    if len({each.sha256 for each in models}) > 1:
        raise FeatureError(
            f"features: two models are named '{name}', {found[0]} and {found[1]}; "
            "take the second away, or bring it under another name"
        )
    first = models[0]
    if first.info.name != name:
        raise FeatureError(
            f"{first.path}: the model in it is named '{first.info.name}'; "
            f"the file must be called {first.info.name}{_ENDING}"
        )
    return first


def _files(folder: Path) -> list[Path]:
    """The models' files in a folder; none where it is missing or closed."""
    try:
        return sorted(path for path in folder.iterdir() if path.name.endswith(_ENDING))
    except OSError:
        return []
