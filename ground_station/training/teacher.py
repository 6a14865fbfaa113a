"""Labels by homographic adaptation of a network that others trained: ALIKE.

A point is one that the teacher finds again from many sides (DeTone et al., "SuperPoint", CVPR-W
2018, section 5), here also in several lights: its score maps over random homographies of all
pictures of one place are brought back and averaged.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import onnx
from onnx import helper, numpy_helper

from ground_station.arrays import F32, U8
from ground_station.features import catalogue, detection, model, sampling
from ground_station.features.inference import Network
from ground_station.features.model_info import Model
from ground_station.training.errors import TrainingError
from ground_station.training.warps import WarpLimits, around

# ALIKE's head is one convolution of size 1 over features that are brought to full size and put
# together. Both are linear: the head may come first, on each part at its own size, and only its
# one channel is enlarged. Without descriptors that leaves nothing wide at full size.


def scores_only(teacher: Model) -> Model:
    """A network of layout `pixels` without its output `descriptors`.

    Its head comes first if the graph is Sigmoid(Conv(Concat(...))) without bias, as ALIKE's is;
    another graph keeps its shape.
    """
    proto = onnx.load_from_string(teacher.data)
    graph = proto.graph
    made = {output: node for node in graph.node for output in node.output}
    constants = {tensor.name: tensor for tensor in graph.initializer}
    sigmoid = made["scores"]
    head = made.get(sigmoid.input[0])
    joined = made.get(head.input[0]) if head is not None else None
    if (
        sigmoid.op_type == "Sigmoid"
        and head is not None
        and head.op_type == "Conv"
        and len(head.input) == 2
        and joined is not None
        and joined.op_type == "Concat"
        and head.input[1] in constants
    ):
        weight = numpy_helper.to_array(constants[head.input[1]])
        share = weight.shape[1] // len(joined.input)
        total = ""
        for k, part in enumerate(joined.input):
            resize = made[part] if made[part].op_type == "Resize" else None
            name = f"head_{k}"
            slice_ = weight[:, k * share : (k + 1) * share]
            graph.initializer.append(numpy_helper.from_array(slice_.copy(), f"{name}.weight"))
            source = part if resize is None else resize.input[0]
            graph.node.append(helper.make_node("Conv", [source, f"{name}.weight"], [name], name))
            if resize is not None:
                larger = onnx.NodeProto()
                larger.CopyFrom(resize)
                larger.name, larger.input[0], larger.output[0] = f"{name}.up", name, f"{name}.up"
                graph.node.append(larger)
                name = f"{name}.up"
            if total:
                graph.node.append(helper.make_node("Add", [total, name], [f"sum_{k}"], f"sum_{k}"))
                name = f"sum_{k}"
            total = name
        graph.node.remove(sigmoid)
        graph.node.append(helper.make_node("Sigmoid", [total], ["scores"], sigmoid.name))
    _prune(graph)
    return replace(teacher, data=proto.SerializeToString())


def _prune(graph: onnx.GraphProto) -> None:
    """Leaves what `scores` needs, in the order that there was."""
    made = {output: node for node in graph.node for output in node.output}
    needed, waiting = set(), ["scores"]
    while waiting:
        name = waiting.pop()
        if name not in needed:
            needed.add(name)
            if name in made:
                waiting += list(made[name].input)
    nodes = [node for node in graph.node if node.output[0] in needed]
    weights = [tensor for tensor in graph.initializer if tensor.name in needed]
    outputs = [output for output in graph.output if output.name == "scores"]
    del graph.node[:], graph.initializer[:], graph.output[:]
    graph.node.extend(nodes)
    graph.initializer.extend(weights)
    graph.output.extend(outputs)


Rng = np.random.Generator

_NMS_PX = 3
_REFINE_PX = 2
_TEMPERATURE = 0.1
_LEAST_SCORE = 0.04
"""Of the average; a ramp above it says how much a point counts (`pairs`)."""
_EDGE_PX = 8
"""A warped picture ends here: near its edge the teacher sees the edge."""


@dataclass(frozen=True)
class Labels:
    """N points: `points_px` (N, 2) float32; `scores` (N,); `descriptors` (N, D) float16, unit."""

    points_px: F32
    scores: F32
    descriptors: npt.NDArray[np.float16]


def load(name: str) -> Model:
    """A teacher by the name of a model or the path of its file; raises `FeatureError`."""
    found = model.read(name) if Path(name).suffix == ".onnx" else catalogue.find(name)
    if found.info.layout != "pixels":
        raise TrainingError(f"teacher: layout of {name} is '{found.info.layout}', not 'pixels'")
    return found


class Teacher:
    """ALIKE's network, asked about one place at a time."""

    def __init__(self, teacher: Model, threads: int = 1) -> None:
        self._whole = Network(teacher, threads=threads)
        self._detector = Network(scores_only(teacher), threads=threads)

    def label(self, views: U8, warps: int, most: int, rng: Rng) -> Labels:
        """Labels of a place from its pictures (V, H, W), sides multiples of 32, in V lights.

        Each picture is looked at as it is, and `warps` times one of them turned. Descriptors are
        those of the first.
        """
        size = (views.shape[1], views.shape[2])
        total = np.zeros(size, np.float32)
        count = np.zeros(size, np.float32)
        limits = WarpLimits(any_roll=0.0)
        first = self._whole.run(_colour(views[0]))
        total += first["scores"][0, 0]
        for view in views[1:]:
            total += self._detector.run(_colour(view))["scores"][0, 0]
        count += len(views)
        whole = np.zeros(size, np.float32)
        whole[_EDGE_PX:-_EDGE_PX, _EDGE_PX:-_EDGE_PX] = 1
        for k in range(warps):
            matrix = around(rng, size, limits)
            flags = cv2.INTER_LINEAR
            turned = cv2.warpPerspective(
                views[k % len(views)], matrix, size[::-1], flags=flags | cv2.WARP_INVERSE_MAP,
                borderMode=cv2.BORDER_REFLECT_101,
            )  # fmt: skip
            scores = self._detector.run(_colour(turned))["scores"][0, 0]
            # Back: each pixel of the picture asks the turned one, of which only the middle counts.
            total += cv2.warpPerspective(scores * whole, matrix, size[::-1], flags=flags)
            count += cv2.warpPerspective(whole, matrix, size[::-1], flags=flags)
        mean = total / count
        rows, columns = detection.strongest(
            mean, radius_px=_NMS_PX, threshold=_LEAST_SCORE, border_px=4, most=most
        )
        points = detection.refined(
            mean, rows, columns, radius_px=_REFINE_PX, temperature=_TEMPERATURE
        )
        unit, _ = sampling.unit(sampling.bilinear(first["descriptors"][0], points))
        return Labels(points, mean[rows, columns], unit.astype(np.float16))


def _colour(picture: npt.NDArray[Any]) -> F32:
    """A grey picture (H, W) uint8 as the network takes it: (1, 3, H, W), 0..1."""
    grey = picture.astype(np.float32) * np.float32(1 / 255)
    return np.repeat(grey[None, None], 3, axis=1)
