"""Features of a network of layout `pixels`: ALIKE's."""

from __future__ import annotations

import numpy as np

from ground_station.arrays import F32, U8
from ground_station.features import detection, sampling
from ground_station.features.extractor import Features, check_image
from ground_station.features.inference import Network
from ground_station.features.learned import LearnedFeatures
from ground_station.features.padding import padded
from ground_station.features.settings import LearnedSettings

NMS_PX = 2
THRESHOLD = 0.2
"""Those of the published program's demonstration."""

_TEMPERATURE = 0.1
"""Of the soft-argmax; the paper's."""


class PixelFeatures(LearnedFeatures):
    """Zhao et al., "ALIKE: Accurate and Lightweight Keypoint Detection and Descriptor Extraction",
    IEEE T-MM 2022: maxima of the score map, refined by a soft-argmax over the window of the
    suppression (section III-B), descriptors interpolated there bilinearly.

    The network takes colour; a grey picture is given to it three times.
    """

    NMS_PX, THRESHOLD = NMS_PX, THRESHOLD

    def __init__(self, network: Network, max_features: int, settings: LearnedSettings) -> None:
        super().__init__(network, max_features, settings)
        self._window_px = self._info.subpixel_px or NMS_PX

    def extract(self, image: U8) -> Features:
        """Features of a grey image (H, W) uint8, strongest first."""
        check_image(image)
        whole = padded(image, self._info.multiple).astype(np.float32) * np.float32(1 / 255)
        colour = np.repeat(whole[None, None], 3, axis=1)
        outputs = self._network.run(colour)
        return self.of_outputs(outputs["scores"][0, 0], outputs["descriptors"][0], image.shape)

    def of_outputs(
        self,
        scores: F32,
        descriptors: F32,
        shape: tuple[int, ...],
    ) -> Features:
        """Features of a picture of `shape` (H, W) from what the network said of the padded one.

        `scores` (H', W'), 0..1; `descriptors` (D, H', W').
        """
        scores = scores[: shape[0], : shape[1]]
        if not (known := np.isfinite(scores)).all():
            scores = np.where(known, scores, np.float32(0))
        rows, columns = detection.strongest(
            scores,
            radius_px=self.nms_px,
            threshold=self.threshold,
            border_px=max(self.nms_px, self._window_px),
            most=self.max_features,
        )
        points = detection.refined(
            scores, rows, columns, radius_px=self._window_px, temperature=_TEMPERATURE
        )
        vectors, good = sampling.unit(sampling.bilinear(descriptors, points))
        return Features(points[good], scores[rows, columns][good], vectors[good])
