"""A model's network, run by onnxruntime."""

from __future__ import annotations

import os
from typing import Any

import cv2
import numpy as np
import onnxruntime

from ground_station.arrays import F32, U8
from ground_station.features.extractor import FeatureError
from ground_station.features.model_info import Model, ModelInfo

_SUFFIX = "ExecutionProvider"
_WARM_UP_PX = (480, 640)
"""The first picture takes several times as long as the others: memory is found, kernels are
prepared. The blimp's camera has this size; a picture of another is slow once more."""


def providers() -> dict[str, str]:
    """The execution providers of the onnxruntime that is installed, by the settings' names."""
    return {
        name.removesuffix(_SUFFIX).lower(): name for name in onnxruntime.get_available_providers()
    }


def threads_beside_tracker() -> int:
    """All cores this process may use but one, which the tracker has; at least one, at most 4.

    A ground station has other work than one network, and other payloads.
    """
    return min(4, max(1, len(os.sched_getaffinity(0)) - 1))


def network_input(info: ModelInfo, image: U8) -> F32:
    """What a model's network takes of a picture (H, W): (1, channels, H', W') 0..1.

    The picture's last row and column are repeated to the next multiples: no edge is added. A grey
    picture is given three times to a network that takes colour.
    """
    below, right = (-side % info.multiple for side in image.shape)
    if below or right:
        image = np.asarray(
            cv2.copyMakeBorder(image, 0, below, 0, right, cv2.BORDER_REPLICATE), np.uint8
        )
    grey = image.astype(np.float32)[None, None] * np.float32(1 / 255)
    return np.repeat(grey, info.channels, axis=1) if info.channels > 1 else grey


class Network:
    """One session; safe to be called from several threads. Warm when it is made.

    Raises `FeatureError` with one line where the provider is missing or cannot run here, or where
    onnxruntime refuses the graph or what it needs of memory.
    """

    def __init__(self, model: Model, provider: str = "cpu", threads: int = 1) -> None:
        self.model, self.provider = model, provider
        known = providers()
        if provider not in known:
            raise FeatureError(
                f"features: onnxruntime has no execution provider '{provider:.40}' here "
                f"(there are: {', '.join(sorted(known))})"
            )
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.log_severity_level = 4  # what is wrong comes as an exception; its log is noise
        # Threads that wait for work in a loop take the tracker's core: a picture at 1.2 GMAC with
        # two threads took 26 ms of processor time without that, 88 ms with it, and was no faster.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        # Not `session.set_denormal_as_zero`: it sets the calling thread's arithmetic for good.
        # What a provider has no kernel for, onnxruntime's own run.
        wanted = [(known[provider], _options(provider, threads)), ("CPU" + _SUFFIX, {})]
        try:
            self._session = onnxruntime.InferenceSession(
                model.data, options, providers=wanted[:1] if provider == "cpu" else wanted
            )
        except Exception as error:  # onnxruntime's have no common base but this
            raise FeatureError(f"{model.path}: onnxruntime refuses it: {_line(error)}") from None
        if self._session.get_providers()[0] != known[provider]:
            # onnxruntime falls back without a word, and a tracker would be as slow as without it.
            raise FeatureError(
                f"features: the execution provider '{provider}' is installed but cannot run here"
            )
        self._outputs = [output.name for output in self._session.get_outputs()]
        self.run_on(np.zeros(_WARM_UP_PX, np.uint8))

    def run_on(self, image: U8) -> dict[str, F32]:
        """The outputs by name for one picture (H, W) uint8, padded."""
        return self.run(network_input(self.model.info, image))

    def run(self, image: F32) -> dict[str, F32]:
        """The outputs by name for pictures (N, channels, H, W), H and W of the right multiple."""
        try:
            values: list[Any] = self._session.run(self._outputs, {"image": image})
        except Exception as error:  # as above; too little memory, for one
            raise FeatureError(f"{self.model.path}: onnxruntime failed: {_line(error)}") from None
        return {
            name: np.asarray(value, np.float32)
            for name, value in zip(self._outputs, values, strict=True)
        }


def _options(provider: str, threads: int) -> dict[str, str]:
    """What a provider is told beside the session's options, which OpenVINO does not look at."""
    if provider == "openvino":
        return {"device_type": "CPU", "num_of_threads": str(threads)}
    return {}


def _line(error: Exception) -> str:
    return (" ".join(str(error).split()) or type(error).__name__)[:200]
