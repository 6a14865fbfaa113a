"""ALIKE's detector alone: the same scores for a fraction of the work.

Its head is one convolution of size 1 over features that are brought to full size and put together.
Both are linear: the head may come first, on each part at its own size, and only its one channel is
enlarged. Without descriptors that leaves nothing wide at full size.
"""

from __future__ import annotations

from dataclasses import replace

import onnx
from onnx import helper, numpy_helper

from ground_station.features.model_info import Model


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
