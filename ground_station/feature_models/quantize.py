"""A smaller form of a model, int8, calibrated on the user's pictures: what it loses and takes."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import helper
from onnxruntime.quantization import (
    CalibrationDataReader,
    CalibrationMethod,
    QuantFormat,
    QuantType,
    quantize_static,
)

from ground_station.arrays import U8
from ground_station.feature_models import homographic
from ground_station.feature_models.graph import serialized
from ground_station.feature_models.homographic import Matching
from ground_station.features.extractor import FeatureError
from ground_station.features.extractors import of_network
from ground_station.features.inference import Network, network_input
from ground_station.features.model_info import Model, ModelInfo
from ground_station.progress import Progress
from ground_station.recording.frames import FrameSource

_OPERATORS = ["Conv", "Relu", "Clip", "MaxPool", "AveragePool", "Add", "Concat", "Resize"]
"""Those that onnxruntime's CPU runs on integers; what stands between others stays float."""
_EXACT = {
    "blobs": ("descriptors", "details", "worth"),
    "cells": ("logits", "descriptors"),
    "pixels": ("scores",),
}
"""Outputs whose last convolutions stay float: rounding there makes ties."""
_READY = ("onnx.quant.pre_process", "onnxruntime.quant")
"""Says to the quantizer that nothing is left to fold: our graphs are built folded."""
_LONGEST_ORIGIN = 180
"""Of the characters that `ModelInfo` allows a source."""

_MAX_FEATURES = 1000
_TIMED = 15


def int8(model: Model, images: Sequence[U8], name: str) -> tuple[bytes, ModelInfo]:
    """The file of a model in int8, with its own name, and what it is.

    `images` (H, W) uint8 calibrate it: static, per channel of the weights, unsigned activations,
    with the range that each had at most (Jacob et al., CVPR 2018). Raises `FeatureError`.
    """
    changed = _int8(check(model), model.info, images)
    origin = model.info.source[:_LONGEST_ORIGIN]
    source = f"{origin}; int8 of {model.info.name} {model.sha256[:16]}"
    info = replace(model.info, name=name, source=source)
    return serialized(changed, info), info


def check(model: Model) -> onnx.ModelProto:
    """The graph of an fp32 model; raises `FeatureError` for another."""
    proto = onnx.load_model_from_string(model.data)
    if any(node.op_type in ("QuantizeLinear", "Cast") for node in proto.graph.node):
        raise FeatureError(f"{model.path}: the model '{model.info.name}' is no fp32 model")
    return proto


def _int8(proto: onnx.ModelProto, info: ModelInfo, images: Sequence[U8]) -> onnx.ModelProto:
    if not images:
        raise FeatureError("int8 needs pictures to calibrate by, and there is none")
    helper.set_model_props(proto, dict([_READY]))
    with tempfile.TemporaryDirectory(prefix="blimp-quantize-") as folder:
        path = Path(folder) / "model.onnx"
        try:
            quantize_static(
                proto,
                path,
                _Reader(info, images),
                quant_format=QuantFormat.QDQ,
                op_types_to_quantize=_OPERATORS,
                per_channel=True,
                # Seven bits of weights: without VNNI a CPU's sums of two products overflow at
                # eight. On ALIKE-t and -n (simulated flight, 8 pairs) both lose the same.
                reduce_range=True,
                activation_type=QuantType.QUInt8,
                weight_type=QuantType.QInt8,
                nodes_to_exclude=[
                    name for end in _EXACT[info.layout] for name in _last(proto.graph, end)
                ],
                calibrate_method=CalibrationMethod.MinMax,
            )
            return onnx.load(path)
        except Exception as error:  # onnxruntime's and the quantizer's have no common base
            reason = " ".join(str(error).split()) or type(error).__name__
            raise FeatureError(f"{info.name}: cannot be quantized: {reason:.200}") from None


class _Reader(CalibrationDataReader):
    """Gives the quantizer one picture after the other."""

    def __init__(self, info: ModelInfo, images: Sequence[U8]) -> None:
        self._inputs = ({"image": network_input(info, image)} for image in images)

    def get_next(self) -> dict[str, Any] | None:
        return next(self._inputs, None)


def _last(graph: onnx.GraphProto, output: str) -> Iterator[str]:
    """The nodes from the last convolution to an output, both included."""
    makers = {name: node for node in graph.node for name in node.output}
    open_ends, seen = [output], set()
    while open_ends:
        node = makers.get(open_ends.pop())
        if node is None or node.name in seen:
            continue
        seen.add(node.name)
        yield node.name
        if node.op_type not in ("Conv", "ConvTranspose", "MatMul"):
            open_ends.extend(node.input)


@dataclass(frozen=True)
class Comparison:
    """Both in one run; `ms` is the median time of the network for the first picture."""

    reference: Matching
    variant: Matching
    reference_ms: float
    variant_ms: float
    shape: tuple[int, ...]
    pairs: int

    @property
    def time_ratio(self) -> float:
        """The variant's time for the model's."""
        return self.variant_ms / self.reference_ms


def compare(
    reference: Model, variant: Model, images: Sequence[U8], threads: int, seed: int
) -> Comparison:
    """Matches each picture (H, W) uint8 with a warp of it, and runs both in turn for the time."""
    networks = [Network(model, threads=threads) for model in (reference, variant)]
    random = np.random.default_rng(seed)
    pairs = [(image, *homographic.warp(image, random)) for image in images]
    of_reference, of_variant = (
        homographic.matching(of_network(network, _MAX_FEATURES), pairs) for network in networks
    )
    times: list[list[float]] = [[], []]
    blob = network_input(reference.info, images[0])
    # In turn, so that what else the machine does is in both.
    for _ in range(_TIMED):
        for network, taken in zip(networks, times, strict=True):
            began = time.perf_counter()
            network.run(blob)
            taken.append((time.perf_counter() - began) * 1e3)
    reference_ms, variant_ms = (float(np.median(taken)) for taken in times)
    return Comparison(
        of_reference, of_variant, reference_ms, variant_ms, images[0].shape, len(pairs)
    )


def evenly(source: FrameSource, count: int) -> list[U8]:
    """`count` pictures of an input, evenly over it; all where it has no more.

    In one pass and with memory for twice as many: when these are full, every second goes.
    """
    kept: list[U8] = []
    step = 1
    with Progress("frames", source.count()) as progress:
        for number, frame in enumerate(source):
            progress.step()
            if number % step:
                continue
            kept.append(frame.image)
            if len(kept) >= 2 * count:
                kept = kept[::2]
                step *= 2
    places = np.linspace(0, len(kept) - 1, min(count, len(kept))).round().astype(int)
    return [kept[place] for place in places]
