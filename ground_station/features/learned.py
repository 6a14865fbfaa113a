"""What extractors over a network have in common: whose model it is, and which points it keeps."""

from __future__ import annotations

from ground_station.features.inference import Network
from ground_station.features.settings import LearnedSettings


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
