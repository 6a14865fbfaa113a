"""A learned model's file: ONNX, with what a user of it must know in its metadata."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

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
        """The file's metadata, as `of_metadata` reads it."""
        values = {
            "schema": SCHEMA,
            "name": self.name,
            "layout": self.layout,
            "dimension": str(self.dimension),
            "multiple": str(self.multiple),
            "licence": self.licence,
            "source": self.source,
            "nms_px": None if self.nms_px is None else str(self.nms_px),
            "threshold": None if self.threshold is None else repr(self.threshold),
            "subpixel_px": str(self.subpixel_px) if self.subpixel_px else None,
            "distance_scale": None if self.distance_scale == 1 else repr(self.distance_scale),
            "details": str(self.details) if self.details else None,
        }
        return {_PREFIX + key: value for key, value in values.items() if value is not None}

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

        def text(key: str) -> str:
            if _PREFIX + key not in metadata:
                raise FeatureError(f"its metadata lacks '{_PREFIX}{key}'")
            return metadata[_PREFIX + key]

        def whole(key: str) -> int:
            if not re.fullmatch(r"\d{1,6}(\.0)?", text(key), re.ASCII):
                raise FeatureError(f"{key} is '{text(key):.40}', not a whole number")
            return int(float(text(key)))

        def real(key: str) -> float:
            try:
                return float(text(key))
            except ValueError:
                raise FeatureError(f"{key} is '{text(key):.40}', not a number") from None

        return cls(
            name=text("name"),
            layout=text("layout"),
            dimension=whole("dimension"),
            multiple=whole("multiple"),
            licence=text("licence"),
            source=text("source"),
            nms_px=whole("nms_px") if _PREFIX + "nms_px" in metadata else None,
            threshold=real("threshold") if _PREFIX + "threshold" in metadata else None,
            subpixel_px=whole("subpixel_px") if _PREFIX + "subpixel_px" in metadata else 0,
            details=whole("details") if _PREFIX + "details" in metadata else 0,
            distance_scale=(
                real("distance_scale") if _PREFIX + "distance_scale" in metadata else 1.0
            ),
        )


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
