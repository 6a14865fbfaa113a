"""A learned model's file: ONNX, with what a user of it must know in its metadata."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any

from ground_station.features.extractor import FeatureError

SCHEMA = "blimp.features/1.0"
LAYOUTS = ("blobs", "cells", "pixels")
MAX_BYTES = 64 << 20
"""SuperPoint's weights have 5.2 MB; a file that claims more than this is none of ours."""

SCALES = 0.25, 4.0
"""The least and the largest `distance_scale`: unit vectors are at most 2 apart."""

_PREFIX = "blimp."
_NAME = re.compile(r"[a-z0-9][a-z0-9._-]{0,63}")
_MOST_TEXT = 300


@dataclass(frozen=True)
class ModelInfo:
    """What the metadata of a model's file says, under keys `blimp.*`.

    `layout` is what goes in and out, images always with centres of pixels at whole numbers:

    - `blobs` (our own): `image` (N, 1, H, W) grey 0..1 to `descriptors` (N, D - `details`, H/8,
      W/8), `details` (N, `details`, H/4, W/4), the two parts of a descriptor before it is
      normalised, and `worth` (N, 1, H/8, W/8), log odds; key points are the picture's own
      (`features.blobs`);
    - `cells` (SuperPoint's): `image` (N, 1, H, W) grey 0..1 to `logits` (N, 65, H/8, W/8), where
      channel k < 64 is pixel (k // 8, k % 8) of its cell and 64 is "none", and `descriptors`
      (N, D, H/8, W/8), not normalised;
    - `pixels` (ALIKE's): `image` (N, 3, H, W) RGB 0..1 to `scores` (N, 1, H, W), 0..1, and
      `descriptors` (N, D, H, W).

    H and W must be multiples of `multiple`. `nms_px` and `threshold` are the distance of two key
    points and the least score that the model was made for; None: the layout's usual ones.
    `subpixel_px` is the reach of the window in which a key point is refined; 0: it stays on its
    pixel, as SuperPoint's do. `distance_scale`: how far apart the descriptors of one point in two
    views are, over RootSIFT's; see `feature_models.scale`.
    """

    name: str
    layout: str
    dimension: int
    multiple: int
    licence: str
    source: str
    nms_px: int | None = None
    threshold: float | None = None
    subpixel_px: int = 0
    distance_scale: float = 1.0
    details: int = 0

    def __post_init__(self) -> None:
        """Raises `FeatureError` with one line for a value that no model has."""
        check_name(self.name)
        if self.layout not in LAYOUTS:
            raise FeatureError(f"layout is '{self.layout:.40}'; allowed: {', '.join(LAYOUTS)}")
        numbers = (
            ("dimension", self.dimension, 2, 1024),
            ("multiple", self.multiple, 1, 64),
            ("nms_px", 4 if self.nms_px is None else self.nms_px, 1, 64),
            ("threshold", 0.0 if self.threshold is None else self.threshold, 0, 1),
            ("subpixel_px", self.subpixel_px, 0, 8),
            ("distance_scale", self.distance_scale, *SCALES),
            (
                "details",
                self.details,
                *((1, self.dimension - 1) if self.layout == "blobs" else (0, 0)),
            ),
        )
        for key, value, low, high in numbers:
            if not low <= value <= high:  # neither is NaN
                raise FeatureError(f"{key} is {value}; allowed: {low} to {high}")
        if self.layout != "pixels" and self.multiple % 8:
            raise FeatureError(f"multiple is {self.multiple}; {self.layout} need a multiple of 8")
        for key, text in (("licence", self.licence), ("source", self.source)):
            if not text.isprintable() or not 0 < len(text) <= _MOST_TEXT:
                raise FeatureError(f"{key} must be one line of at most {_MOST_TEXT} characters")

    @property
    def channels(self) -> int:
        """Of the picture that goes in."""
        return 3 if self.layout == "pixels" else 1

    def metadata(self) -> dict[str, str]:
        """The file's metadata, as `of_metadata` reads it; what is as usual is left out."""
        said = {"schema": SCHEMA}
        for each in fields(self):
            value = getattr(self, each.name)
            if value != each.default:
                said[each.name] = value if isinstance(value, str) else repr(value)
        return {_PREFIX + key: value for key, value in said.items()}

    @classmethod
    def of_metadata(cls, metadata: Mapping[str, str]) -> ModelInfo:
        """Reads `metadata`; raises `FeatureError` with one line. Keys that it has not are others'.

        A file of a newer schema is refused, so that what it adds is never silently left out.
        """
        if _PREFIX + "schema" not in metadata:
            raise FeatureError(f"no model of ours: its metadata lacks '{_PREFIX}schema'")
        schema = metadata[_PREFIX + "schema"]
        if schema != SCHEMA:
            raise FeatureError(f"its schema is '{schema:.40}'; this program reads '{SCHEMA}'")
        values: dict[str, Any] = {}
        for each in fields(cls):
            text = metadata.get(_PREFIX + each.name)
            if text is not None:
                read = _READERS[str(each.type).removesuffix(" | None")]
                values[each.name] = read(each.name, text)
            elif each.default is MISSING:
                raise FeatureError(f"its metadata lacks '{_PREFIX}{each.name}'")
        return cls(**values)


def _whole(key: str, text: str) -> int:
    if not re.fullmatch(r"\d{1,6}(\.0)?", text, re.ASCII):
        raise FeatureError(f"{key} is '{text:.40}', not a whole number")
    return int(float(text))


def _real(key: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise FeatureError(f"{key} is '{text:.40}', not a number") from None


_READERS: dict[str, Callable[[str, str], Any]] = {
    "str": lambda key, text: text, "int": _whole, "float": _real,
}  # fmt: skip


@dataclass(frozen=True)
class Model:
    """A file that was read and found harmless: its bytes are what is run, not the path again."""

    path: Path
    info: ModelInfo
    data: bytes
    sha256: str


def check_name(name: str) -> None:
    """Raises `FeatureError` unless this may be a model's name: it is a file's and a setting's."""
    if not _NAME.fullmatch(name):
        raise FeatureError(
            f"name is '{name:.80}'; allowed: at most 64 of a-z, 0-9, '.', '_' and '-', "
            "a letter or digit first"
        )
