"""Files of torch.save and safetensors are read as they are; nothing in them is ever run."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch_files as made
from safetensors.numpy import save

from ground_station.feature_models import torch_file, torch_tensors
from ground_station.feature_models.torch_file import Weights, WeightsError

RNG = np.random.default_rng(5)
TENSORS = {
    "conv.weight": RNG.normal(size=(2, 1, 2, 2)).astype(np.float32),
    "bn.bias": RNG.normal(size=3).astype(np.float32),
}
WHOLE = {
    "zip": made.zip_of(TENSORS),
    "legacy": made.legacy_of(TENSORS),
    "python2": made.legacy_of(TENSORS, python2=True),
    "safetensors": save(TENSORS),
}
BIG_ENDIAN = made.pickled(b"}" + made.text("little_endian") + b"\x89s")


def read(path: Path, data: bytes) -> Weights:
    path.write_bytes(data)
    return torch_file.read(path)


def refused(path: Path, data: bytes) -> str:
    """The one line that a file is refused with."""
    with pytest.raises(WeightsError) as caught:
        read(path, data)
    line = str(caught.value)
    assert len(line.splitlines()) == 1 and line.startswith(f"{path}: ")
    return line


def fails(data: bytes) -> None:
    """The program that reads torch's files ends with an error, whichever."""
    try:
        torch_tensors.tensors(data)
    except Exception:
        return
    raise AssertionError("it was read")


def same(weights: Weights) -> bool:
    return list(weights.tensors) == list(TENSORS) and all(
        weights.tensors[name].dtype == array.dtype and np.array_equal(weights.tensors[name], array)
        for name, array in TENSORS.items()
    )


@pytest.mark.parametrize("kind", WHOLE)
def test_names_shapes_and_every_bit_are_as_in_the_file(tmp_path: Path, kind: str) -> None:
    weights = read(tmp_path / "w.pth", WHOLE[kind])
    assert set(weights.tensors) == set(TENSORS)
    for name, array in TENSORS.items():
        taken = weights.take(name, array.shape)
        assert taken.dtype == np.float32 and taken.tobytes() == array.tobytes()


def test_a_tensor_is_where_offset_and_strides_say(tmp_path: Path) -> None:
    numbers = np.arange(24, dtype=np.float32)
    source = made.storage("0", numbers.dtype, 24)
    body = b"}(" + made.text("turned") + made.tensor(source, (4, 6), (1, 4))
    body += made.text("part") + made.tensor(source, (2, 3), (6, 1), offset=8)
    body += made.text("one") + made.tensor(source, (), (), offset=5)
    body += made.text("none") + made.tensor(source, (0, 3), (3, 1), offset=24) + b"u"
    weights = read(tmp_path / "w.pth", made.as_zip(made.pickled(body), {"0": numbers.tobytes()}))
    assert np.array_equal(weights.take("turned", (4, 6)), numbers.reshape(6, 4).T)
    assert np.array_equal(weights.take("part", (2, 3)), numbers.reshape(4, 6)[1:3, 2:5])
    assert weights.take("one", ()) == 5 and weights.tensors["none"].shape == (0, 3)


def test_halves_and_doubles_are_taken_as_floats_and_integers_are_no_weights(
    tmp_path: Path,
) -> None:
    tensors = {
        "half": np.array([0.5, -2], np.float16),
        "double": np.array([0.1, 1e300]),
        "count": np.array([7], np.int64),
    }
    data = made.as_zip(made.pickled(made.state(tensors)), made.contents(tensors))
    weights = read(tmp_path / "w.pth", data)
    assert weights.take("half", (2,)).tolist() == [0.5, -2]
    with pytest.raises(WeightsError, match="double has values that are not finite"):
        weights.take("double", (2,))
    with pytest.raises(WeightsError, match="count holds int64, no weights"):
        weights.take("count", (1,))


def test_a_checkpoint_of_a_training_gives_its_weights(tmp_path: Path) -> None:
    parameter = made.name("torch._utils", "_rebuild_parameter")
    inner = made.tensor(made.storage("0", np.dtype("f4"), 2), (2,), (1,))
    hooks = made.name("collections", "OrderedDict") + b")R"
    weights = b"}" + made.text("a") + parameter + made.group([inner, b"\x88", hooks]) + b"Rs"
    body = b"}(" + made.text("epoch") + made.number(7) + made.text("lr")
    body += b"G?\xb9\x99\x99\x99\x99\x99\x9a" + made.text("betas") + b"](K\x01K\x02e"
    body += made.text("state_dict") + weights + b"u"
    numbers = np.array([3, 4], np.float32)
    data = made.as_zip(made.pickled(body), {"0": numbers.tobytes()})
    assert read(tmp_path / "w.pth", data).take("a", (2,)).tolist() == [3, 4]


def test_newer_protocols_of_pickle_are_read(tmp_path: Path) -> None:
    """MEMOIZE, SHORT_BINUNICODE, STACK_GLOBAL and a FRAME, as protocol 4 has them."""

    def short(value: str) -> bytes:
        return b"\x8c" + bytes([len(value)]) + value.encode() + b"\x94"

    kind = short("torch") + short("FloatStorage") + b"\x93\x94"
    source = made.group([short("storage"), kind, short("0"), short("cpu"), b"K\x02"]) + b"\x94Q"
    call = short("torch._utils") + short("_rebuild_tensor_v2") + b"\x93\x94"
    parts = [source, b"K\x00", b"K\x02\x85", b"K\x01\x85", b"\x89", b"N"]
    body = b"}\x94" + short("a") + call + made.group(parts) + b"\x94R\x94s"
    body = b"\x95" + len(body).to_bytes(8, "little") + body
    data = made.as_zip(made.pickled(body, protocol=4), {"0": bytes(8)})
    assert read(tmp_path / "w.pth", data).take("a", (2,)).tolist() == [0, 0]


def _system(path: Path) -> bytes:
    """What `pickle` makes of an object whose __reduce__ is os.system, and its relatives."""
    return made.text(f"touch {path}") + b"\x85R"


@pytest.mark.parametrize(
    "call",
    [
        lambda file: made.name("os", "system") + _system(file),
        lambda file: made.name("posix", "system") + _system(file),
        lambda file: made.name("builtins", "exec") + _system(file),
        lambda file: made.text("os") + made.text("system") + b"\x93" + _system(file),
        lambda file: b"(" + made.text(f"touch {file}") + b"ios\nsystem\n",
        lambda file: b"(" + made.name("os", "system") + made.text(f"touch {file}") + b"o",
        lambda file: made.name("os", "system") + made.text(f"touch {file}") + b"\x85\x81",
        lambda file: b"\x82\x01",
        lambda file: made.name("torch._utils", "_rebuild_tensor_v2.__globals__") + b")R",
        lambda file: made.name("collections", "OrderedDict.__init__") + b")R",
        lambda file: made.name("torch", "FloatStorage") + b")R",
        lambda file: b"}" + made.text("__class__") + b"R",
        lambda file: b"}" + b"}" + made.text("__setstate__") + made.name("os", "system") + b"sb",
        lambda file: b"Pos\n.",
    ],
)
def test_a_pickle_that_would_run_something_is_refused_and_runs_nothing(
    tmp_path: Path, call: object
) -> None:
    target = tmp_path / "ran"
    body = call(target)  # type: ignore[operator]
    hostile = made.pickled(body)
    for data in (
        made.as_zip(hostile, {}),
        made.as_legacy(hostile, {}),
        made.as_legacy(b"", {}, machine=hostile),
        made.as_legacy(made.pickled(made.state(TENSORS, True)), {}, keys=hostile),
        hostile,
    ):
        fails(data)
    assert not target.exists()


def test_the_refusal_names_what_the_file_names(tmp_path: Path) -> None:
    body = made.name("os", "system") + _system(tmp_path / "ran")
    line = refused(tmp_path / "w.pth", made.as_zip(made.pickled(body), {}))
    assert line.endswith("it names os.system, which no tensor needs")
    body = made.name("os\x1b[2J", "a" * 5000)
    line = refused(tmp_path / "w.pth", made.as_zip(made.pickled(body), {}))
    assert "\x1b" not in line and len(line) < len(str(tmp_path)) + 220


@pytest.mark.parametrize("kind", WHOLE)
def test_a_file_that_is_cut_anywhere_is_refused(tmp_path: Path, kind: str) -> None:
    whole = WHOLE[kind]
    places = np.random.default_rng(1).choice(len(whole), 120, replace=False)
    for place in [0, 1, len(whole) - 1, *places.tolist()]:
        if kind == "safetensors":
            refused(tmp_path / "w.pth", whole[:place])
        else:
            fails(whole[:place])


def test_a_flipped_byte_of_an_archive_is_refused_or_changes_nothing() -> None:
    """Each byte in turn: its lowest bit, its highest, all. There is a sum over what counts."""
    for place in range(len(WHOLE["zip"])):
        data = bytearray(WHOLE["zip"])
        data[place] ^= (0x01, 0x80, 0xFF)[place % 3]
        try:
            tensors = torch_tensors.tensors(bytes(data))
        except Exception:
            continue
        assert same(Weights(Path("w.pth"), tensors))


def _tensor_of(
    count: int, size: tuple[int, ...], stride: tuple[int, ...], offset: int = 0
) -> bytes:
    source = made.storage("0", np.dtype("f4"), count)
    return made.pickled(b"}" + made.text("a") + made.tensor(source, size, stride, offset) + b"s")


@pytest.mark.parametrize(
    ("pickle", "says"),
    [
        (_tensor_of(4, (5,), (1,)), "strides"),
        (_tensor_of(4, (2, 2), (3, 1)), "strides"),
        (_tensor_of(4, (2,), (1,), 3), "strides"),
        (_tensor_of(4, (2,), (1,), -1), "strides"),
        (_tensor_of(4, (0, 3), (1, 1), 2**80), "too big"),
        (_tensor_of(4, (1 << 28, 1 << 28), (0, 0)), "Unable to allocate"),
        (_tensor_of(4, (1 << 32,), (0,)), "Unable to allocate"),
        (_tensor_of(4, (2,), (1, 1)), "strides"),
        (made.pickled(b"K\x01"), "no attribute"),
        (made.pickled(b"}"), "no tensors by name"),
        (made.pickled(b"K\x01Q"), "cannot unpack"),
        (made.pickled(b"]r\xff\xff\xff\x7f"), "MemoryError"),  # the memo would take 16 GB
        (made.pickled(b")q\x00" + b"h\x00h\x00\x86q\x00" * 100 + b"}h\x00K\x01s"), "too long"),
    ],
)
def test_claims_that_do_not_fit_are_refused(
    tmp_path: Path, pickle: bytes, says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch_file, "_SECONDS", 2)
    line = refused(tmp_path / "w.pth", made.as_zip(pickle, {"0": bytes(16)}))
    assert says in line, line


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "Ran out of input"),
        (b"\x80\x02}q\x00.", "Ran out of input"),
        (b"PK\x03\x04" + bytes(100), "File is not a zip file"),
        (made.as_zip(b"", {}).replace(b"data.pkl", b"what.pkl"), "none of torch.save"),
        (made.as_zip(_tensor_of(1, (1,), (1,)), {}), "no item named 'archive/data/0'"),
        (made.as_zip(b"", {}, byteorder=b"big"), "big-endian"),
        (made.legacy_of(TENSORS) + b"\0", "more follows the last tensor"),
        (made.as_legacy(b"", {}, machine=BIG_ENDIAN), "big-endian"),
        (b"\x08" + bytes(7) + b"{       ", "damaged safetensors"),
        (b"\x08" + bytes(7) + b"{}      ", "no tensors by name"),
    ],
)
def test_other_files_are_refused_by_what_they_are(tmp_path: Path, data: bytes, says: str) -> None:
    assert says in refused(tmp_path / "w.pth", data)


def test_weights_are_asked_for_by_name_shape_and_finiteness(tmp_path: Path) -> None:
    tensors = {"a": np.ones((2, 3), np.float32), "nan": np.array([1, np.nan], np.float32)}
    weights = read(tmp_path / "w.pth", made.zip_of(tensors))
    for name, shape, says in (
        ("b", (1,), "the tensor b is missing"),
        ("a", (3, 2), "the tensor a is 2x3; it should be 3x2"),
        ("a", (), "the tensor a is 2x3; it should be a number"),
        ("nan", (2,), "the tensor nan has values that are not finite"),
    ):
        with pytest.raises(WeightsError) as caught:
            weights.take(name, shape)
        assert str(caught.value) == f"{tmp_path / 'w.pth'}: {says}"


def test_a_file_that_is_not_there_or_no_file_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match="No such file"):
        torch_file.read(tmp_path / "none.pth")
    with pytest.raises(WeightsError, match="not a file"):
        torch_file.read(tmp_path)


def test_a_file_larger_than_any_weights_is_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch_file, "MOST_BYTES", 1 << 20)
    path = tmp_path / "w.pth"
    path.touch()
    os.truncate(path, 1 << 40)
    with pytest.raises(WeightsError, match="more than 1 MiB"):
        torch_file.read(path)
