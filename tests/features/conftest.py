"""What extractors look at."""

from __future__ import annotations

import cv2
import numpy as np
import pytest


@pytest.fixture(scope="session")
def picture() -> np.ndarray:
    """A grey picture (480, 640) of soft blobs of all shades."""
    image = np.random.default_rng(0).integers(0, 256, (60, 80), dtype=np.uint8)
    return cv2.GaussianBlur(cv2.resize(image, (640, 480), interpolation=cv2.INTER_CUBIC), None, 2)
