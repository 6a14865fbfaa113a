"""Extractors over a network: what all have in common, and layouts that score each pixel."""

from __future__ import annotations

import numpy as np

from ground_station.arrays import F32, U8
from ground_station.features import detection, sampling
from ground_station.features.extractor import Features, check_image
from ground_station.features.inference import Network
from ground_station.features.settings import LearnedSettings

_BORDER_PX = 4
"""Of `cells`: where SuperPoint keeps no key points."""
_CENTRE_PX = 3.5
"""Of a cell, from the centre of its first pixel."""


class LearnedFeatures:
    """The extractor's side of a network; a layout adds how key points come of its outputs.

    What the settings say of suppression and threshold counts first, then what the model says, then
    the layout's own `NMS_PX` and `THRESHOLD`.
    """

    NMS_PX: int
    THRESHOLD: float

    def __init__(self, network: Network, max_features: int, settings: LearnedSettings) -> None:
        info = network.model.info
        self.name, self.dimension = info.name, info.dimension
        self.sha256 = network.model.sha256
        self.distance_scale = info.distance_scale
        self.max_features = max_features
        self.nms_px = settings.nms_px or info.nms_px or self.NMS_PX
        self.threshold = settings.threshold or (
            self.THRESHOLD if info.threshold is None else info.threshold
        )
        self._network, self._info = network, info

    def _outputs(self, image: U8) -> dict[str, F32]:
        """What the network says of a picture (H, W), padded, by name."""
        check_image(image)
        return {name: out[0] for name, out in self._network.run_on(image).items()}

    def _points(
        self, scores: F32, border_px: int, window_px: int, temperature: float | None = None
    ) -> tuple[F32, F32]:
        """Key points (N, 2) of finite scores (H, W), strongest first, and their scores (N,)."""
        rows, columns = detection.strongest(
            scores,
            radius_px=self.nms_px,
            threshold=self.threshold,
            border_px=border_px,
            most=self.max_features,
        )
        points = detection.refined(
            scores, rows, columns, radius_px=window_px, temperature=temperature
        )
        return points, scores[rows, columns]


def described(points_px: F32, scores: F32, vectors: F32) -> Features:
    """Key points (N, 2) whose vectors (N, D), brought to unit length, are any."""
    vectors, good = sampling.unit(vectors)
    return Features(points_px[good], scores[good], vectors[good])


class CellFeatures(LearnedFeatures):
    """DeTone et al., "SuperPoint", CVPR-W 2018; key points refined where the model says so.

    Scores are a softmax over each cell's 64 pixels and "none"; descriptors are interpolated
    bicubically between the cells' centres and then brought to unit length (section 3.3).
    """

    NMS_PX, THRESHOLD = 4, 0.015  # the paper's and its published program's

    def extract(self, image: U8) -> Features:
        """Features of a grey image (H, W) uint8, strongest first."""
        outputs = self._outputs(image)
        return self.of_outputs(outputs["logits"], outputs["descriptors"], image.shape)

    def of_outputs(self, logits: F32, descriptors: F32, shape: tuple[int, ...]) -> Features:
        """Features of a picture of `shape` (H, W) from what the network said of the padded one.

        `logits` (65, h, w), `descriptors` (D, h, w), for 8h x 8w pixels.
        """
        scores = detection.cell_scores(logits)[: shape[0], : shape[1]]
        window_px = self._info.subpixel_px
        points, strengths = self._points(scores, max(_BORDER_PX, window_px), window_px)
        at = (points - np.float32(_CENTRE_PX)) / np.float32(8)
        return described(points, strengths, sampling.bicubic(descriptors, at))


class PixelFeatures(LearnedFeatures):
    """Zhao et al., "ALIKE: Accurate and Lightweight Keypoint Detection and Descriptor Extraction",
    IEEE T-MM 2022: maxima of the score map, refined by a soft-argmax over the window of the
    suppression (section III-B), descriptors interpolated there bilinearly.
    """

    NMS_PX, THRESHOLD = 2, 0.2  # those of the published program's demonstration
    _TEMPERATURE = 0.1  # of the soft-argmax; the paper's

    def extract(self, image: U8) -> Features:
        """Features of a grey image (H, W) uint8, strongest first."""
        outputs = self._outputs(image)
        return self.of_outputs(outputs["scores"][0], outputs["descriptors"], image.shape)

    def of_outputs(self, scores: F32, descriptors: F32, shape: tuple[int, ...]) -> Features:
        """Features of a picture of `shape` (H, W) from what the network said of the padded one.

        `scores` (H', W'), 0..1; `descriptors` (D, H', W').
        """
        scores = scores[: shape[0], : shape[1]]
        if not (known := np.isfinite(scores)).all():
            scores = np.where(known, scores, np.float32(0))
        window_px = self._info.subpixel_px or self.NMS_PX
        points, strengths = self._points(
            scores, max(self.nms_px, window_px), window_px, self._TEMPERATURE
        )
        return described(points, strengths, sampling.bilinear(descriptors, points))
