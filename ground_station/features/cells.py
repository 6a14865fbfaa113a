"""Features of a network of layout `cells`: SuperPoint's, and our own."""

from __future__ import annotations

import numpy as np

from ground_station.arrays import F32, U8
from ground_station.features import detection, sampling
from ground_station.features.extractor import Features, check_image
from ground_station.features.inference import Network
from ground_station.features.learned import LearnedFeatures
from ground_station.features.padding import padded
from ground_station.features.settings import LearnedSettings

NMS_PX = 4
THRESHOLD = 0.015
"""The paper's and its published program's."""

_BORDER_PX = 4
_CENTRE_PX = 3.5
"""Of a cell, from the centre of its first pixel."""


class CellFeatures(LearnedFeatures):
    """DeTone et al., "SuperPoint", CVPR-W 2018; key points refined where the model says so.

    Scores are a softmax over each cell's 64 pixels and "none"; descriptors are interpolated
    bicubically between the cells' centres and then brought to unit length (section 3.3).
    """

    NMS_PX, THRESHOLD = NMS_PX, THRESHOLD

    def __init__(self, network: Network, max_features: int, settings: LearnedSettings) -> None:
        super().__init__(network, max_features, settings)
        self._border_px = max(_BORDER_PX, self._info.subpixel_px)

    def extract(self, image: U8) -> Features:
        """Features of a grey image (H, W) uint8, strongest first."""
        check_image(image)
        whole = padded(image, self._info.multiple)
        outputs = self._network.run(whole.astype(np.float32)[None, None] * np.float32(1 / 255))
        return self.of_outputs(outputs["logits"][0], outputs["descriptors"][0], image.shape)

    def of_outputs(
        self,
        logits: F32,
        descriptors: F32,
        shape: tuple[int, ...],
    ) -> Features:
        """Features of a picture of `shape` (H, W) from what the network said of the padded one.

        `logits` (65, h, w), `descriptors` (D, h, w), for 8h x 8w pixels.
        """
        scores = detection.cell_scores(logits)[: shape[0], : shape[1]]
        rows, columns = detection.strongest(
            scores,
            radius_px=self.nms_px,
            threshold=self.threshold,
            border_px=self._border_px,
            most=self.max_features,
        )
        points = detection.refined(scores, rows, columns, radius_px=self._info.subpixel_px)
        at = (points - np.float32(_CENTRE_PX)) / np.float32(8)
        vectors, good = sampling.unit(sampling.bicubic(descriptors, at))
        return Features(points[good], scores[rows, columns][good], vectors[good])
