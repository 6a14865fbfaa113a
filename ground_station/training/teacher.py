"""Labels by homographic adaptation of a network that others trained: ALIKE.

A point is one that the teacher finds again from many sides (DeTone et al., "SuperPoint", CVPR-W
2018, section 5), here also in several lights: its score maps over random homographies of all
pictures of one place are brought back and averaged.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from onnx import helper, numpy_helper
from torch import Tensor
from torch.nn import functional

from ground_station.features import catalogue, model
from ground_station.features.model_info import Model
from ground_station.training.errors import TrainingError
from ground_station.training.peaks import highest, refined
from ground_station.training.views import Chance, around

Options = dict[str, Any]

_NMS_PX = 3
_REFINE_PX = 2
_TEMPERATURE = 0.1
_LEAST_SCORE = 0.04
"""Of the average; a ramp above it says how much a point counts (`pairs`)."""
_EDGE_PX = 8
"""A warped picture ends here: near its edge the teacher sees the edge."""


def load(name: str) -> Model:
    """A teacher by the name of a model or the path of its file; raises `FeatureError`."""
    found = model.read(name) if Path(name).suffix == ".onnx" else catalogue.find(name)
    if found.info.layout != "pixels":
        raise TrainingError(f"teacher: layout of {name} is '{found.info.layout}', not 'pixels'")
    return found


class Teacher:
    """A network of layout `pixels`, its scores alone, in torch: as fast as the device is."""

    def __init__(self, teacher: Model, device: torch.device) -> None:
        graph = onnx.load_from_string(teacher.data).graph
        self._nodes = _needed(graph, "scores")
        self._weights = {
            tensor.name: torch.from_numpy(np.array(numpy_helper.to_array(tensor))).to(device)
            for tensor in graph.initializer
        }

    @torch.no_grad()
    def scores(self, pictures: Tensor) -> Tensor:
        """Score maps of grey pictures (N, H, W), 0..1, sides multiples of 32."""
        values = {**self._weights, "image": pictures[:, None].expand(-1, 3, -1, -1)}
        for node in self._nodes:
            inputs = [values[name] for name in node.input if name]
            options = {a.name: helper.get_attribute_value(a) for a in node.attribute}
            if node.op_type not in _OPERATORS:
                raise TrainingError(f"teacher: no operator {node.op_type} is known here")
            values[node.output[0]] = _OPERATORS[node.op_type](inputs, options)
        return values["scores"][:, 0]

    @torch.no_grad()
    def label(self, views: Tensor, warps: int, most: int, chance: Chance) -> tuple[Tensor, Tensor]:
        """Points (N, most, 2), px, strongest first, and scores (N, most), 0 where there is none.

        Of places' pictures (N, L, H, W), 0..1, in L lights. Each is looked at as it is, and
        `warps` times one of them turned.
        """
        count, lights, rows, columns = views.shape
        size = (rows, columns)
        total = torch.stack([self.scores(views[:, k]) for k in range(lights)]).sum(dim=0)
        seen = torch.full_like(total, lights)
        whole = torch.zeros(count, *size, device=views.device)
        whole[:, _EDGE_PX:-_EDGE_PX, _EDGE_PX:-_EDGE_PX] = 1
        for k in range(warps):
            turned = around(chance, count, size)
            scores = self.scores(turned.taken(views[:, k % lights]))
            # Back: each pixel of the picture asks the turned one, of which only the middle counts.
            total += turned.given_back(scores * whole)
            seen += turned.given_back(whole)
        mean = total / seen
        pixels, found = highest(mean, _NMS_PX, 4, _LEAST_SCORE, most)
        return refined(mean, pixels, _REFINE_PX, _TEMPERATURE), found


def _needed(graph: onnx.GraphProto, output: str) -> list[onnx.NodeProto]:
    """The nodes that an output needs, in the order that there was."""
    made = {name: node for node in graph.node for name in node.output}
    needed, waiting = set(), [output]
    while waiting:
        name = waiting.pop()
        if name not in needed:
            needed.add(name)
            waiting += list(made[name].input) if name in made else []
    return [node for node in graph.node if node.output[0] in needed]


def _resized(inputs: list[Tensor], options: Options) -> Tensor:
    aligned = options.get("coordinate_transformation_mode", b"") == b"align_corners"
    return functional.interpolate(
        inputs[0], scale_factor=inputs[-1][2:].tolist(), mode="bilinear", align_corners=aligned
    )


_OPERATORS: dict[str, Callable[[list[Tensor], Options], Tensor]] = {
    "Conv": lambda x, o: functional.conv2d(
        x[0], x[1], x[2] if len(x) > 2 else None, o["strides"], o["pads"][:2]
    ),
    "Relu": lambda x, _: functional.relu(x[0]),
    "MaxPool": lambda x, o: functional.max_pool2d(x[0], o["kernel_shape"], o["strides"]),
    "Add": lambda x, _: x[0] + x[1],
    "Concat": lambda x, _: torch.cat(x, dim=1),
    "Resize": _resized,
    "Sigmoid": lambda x, _: torch.sigmoid(x[0]),
}
