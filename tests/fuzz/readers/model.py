"""`features.inspection.read`: ONNX files, looked through before anything of them is run."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import made_up
import onnx
from onnx import helper
from pieces import Picker, as_json, odd, refusing, scratch

from ground_station.features import inspection, model_info
from ground_station.features.extractor import FeatureError

_FILE = scratch("model") / "made-up.onnx"
_OPERATORS = (*sorted(inspection.OPERATORS), "Loop", "If", "Scan", "Tile", "Range", "Expand", "")
_EXTENTS = (0, 1, 2, 3, 8, 65, 2**20, 2**31, 2**62, -1)


def _whole(layout: str) -> bytes:
    about = made_up.info(layout=layout, multiple=8 if layout == "cells" else 32)
    with tempfile.TemporaryDirectory() as folder:
        if layout == "cells":
            path = made_up.write_cells(Path(folder), about, (2, 2, 4))
        else:
            path = made_up.write_pixels(Path(folder), about)
        return path.read_bytes()


_WHOLE = (_whole("cells"), _whole("pixels"))


def _one_of(picker: Picker, items: Any) -> Any:
    return items[picker.number(1) % len(items)] if len(items) else None


def _change(picker: Picker, proto: onnx.ModelProto) -> None:
    """One thing that a graph says, said otherwise."""
    graph = proto.graph
    node = _one_of(picker, graph.node)
    tensor = _one_of(picker, graph.initializer)
    value = _one_of(picker, [*graph.input, *graph.output])
    how = picker.number(1) % 10
    if how == 0 and node:
        node.op_type = picker.of(_OPERATORS)
    elif how == 1 and node and node.input:
        node.input[picker.number(1) % len(node.input)] = picker.of(
            [name for other in graph.node for name in (*other.input, *other.output)] + ["", "x"]
        )
    elif how == 2 and node and (attribute := _one_of(picker, node.attribute)):
        attribute.ints[:] = [picker.of(_EXTENTS) for _ in range(picker.number(1) % 6)]
    elif how == 3 and node:
        value_of = (picker.of(_EXTENTS), picker.real(), picker.bytes(6))[picker.number(1) % 3]
        name = picker.of(("group", "axis", "kernel_shape", "to", "mode", "blocksize", "new"))
        node.attribute.append(helper.make_attribute(name, value_of))
    elif how == 4 and tensor:
        tensor.dims[:] = [picker.of(_EXTENTS) for _ in range(picker.number(1) % 6)]
    elif how == 5 and tensor:
        tensor.data_type = picker.number(1) % 24
    elif how == 6 and value and (dim := _one_of(picker, value.type.tensor_type.shape.dim)):
        dim.dim_value = picker.of(_EXTENTS)
    elif how == 7 and value:
        value.type.tensor_type.elem_type = picker.number(1) % 24
    elif how == 8:
        entry = _one_of(picker, proto.metadata_props)
        entry.value = as_json(odd(picker)).decode(errors="replace")[:4000]
    elif how == 9:
        proto.opset_import[0].version = picker.of((1, 16, 17, 18, 20, 22, 26, 27, 2**40, -1))


def fuzz(data: bytes) -> None:
    """A model that is taken has the layout's ends, and sizes that are known and bounded."""
    picker = Picker(data)
    how = picker.number(1) % 4
    if how == 3:
        content = picker.rest()
    elif how == 2:
        whole = bytearray(picker.of(_WHOLE))
        while picker.left():
            whole[picker.number(2) % len(whole)] = picker.number(1)
        content = bytes(whole)
    else:
        proto = onnx.load_model_from_string(_WHOLE[how])
        for _ in range(1 + picker.number(1) % 4):
            _change(picker, proto)
        content = proto.SerializeToString()
    _FILE.write_bytes(content)
    with refusing(FeatureError):
        read = inspection.read(_FILE)
        assert read.data == content and len(read.sha256) == 64
        assert 2 <= read.info.dimension <= 1024 and read.info.layout in model_info.LAYOUTS
        assert inspection.macs(read.data, read.info) < 1e12


def seeds() -> list[bytes]:
    """Whole files of both layouts, and one change of each kind."""
    changes = [bytes([which, 0, 1, 1, 1, how, 3, 2, 1]) for which in (0, 1) for how in range(10)]
    return [*(b"\3" + whole for whole in _WHOLE), b"\2\0", b"\3", *changes]
