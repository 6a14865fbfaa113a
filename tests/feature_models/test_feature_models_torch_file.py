"""Files of torch.save and safetensors are read as they are; nothing in them is ever run."""

from __future__ import annotations

import os
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch_files as made
from safetensors.numpy import save

from ground_station.feature_models import pickle_subset, torch_file
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
    ):
        refused(tmp_path / "w.pth", data)
    # Before the magic number it is no file of torch at all.
    refused(tmp_path / "w.pth", hostile)
    assert not target.exists()


def test_the_refusal_names_what_the_file_names(tmp_path: Path) -> None:
    body = made.name("os", "system") + _system(tmp_path / "ran")
    line = refused(tmp_path / "w.pth", made.as_zip(made.pickled(body), {}))
    assert line.endswith("it names os.system, which no tensor needs")
    body = made.name("os\x1b[2J", "a" * 5000)
    line = refused(tmp_path / "w.pth", made.as_zip(made.pickled(body), {}))
    assert "\x1b" not in line and len(line) < len(str(tmp_path)) + 200


@pytest.mark.parametrize("kind", WHOLE)
def test_a_file_that_is_cut_anywhere_is_refused(tmp_path: Path, kind: str) -> None:
    whole = WHOLE[kind]
    places = np.random.default_rng(1).choice(len(whole), 120, replace=False)
    for place in [0, 1, len(whole) - 1, *places.tolist()]:
        refused(tmp_path / "w.pth", whole[:place])
    assert same(read(tmp_path / "w.pth", whole)) or kind == "safetensors"


@pytest.mark.parametrize("kind", WHOLE)
def test_a_flipped_byte_is_refused_or_changes_a_number_and_no_more(kind: str) -> None:
    """Each byte of a file in turn: its lowest bit, its highest, all. An archive has a sum over what
    counts; the other formats have none, so there a number may be another."""
    for place in range(len(WHOLE[kind])):
        data = bytearray(WHOLE[kind])
        data[place] ^= (0x01, 0x80, 0xFF)[place % 3]
        try:
            tensors = torch_file.tensors(bytes(data))
        except pickle_subset.PickleError:
            continue
        if kind == "zip":
            assert same(Weights(Path("w.pth"), tensors))
        assert sum(array.size for array in tensors.values()) <= 64


def _tensor_of(
    count: int, size: tuple[int, ...], stride: tuple[int, ...], offset: int = 0
) -> bytes:
    source = made.storage("0", np.dtype("f4"), count)
    return made.pickled(b"}" + made.text("a") + made.tensor(source, size, stride, offset) + b"s")


@pytest.mark.parametrize(
    ("pickle", "says"),
    [
        (_tensor_of(4, (5,), (1,)), "reaches beyond its storage 0"),
        (_tensor_of(4, (2, 2), (3, 1)), "reaches beyond"),
        (_tensor_of(4, (2,), (1,), 3), "reaches beyond"),
        (_tensor_of(4, (2,), (1,), -1), "reaches beyond"),
        (_tensor_of(4, (0, 3), (1, 1), 2**80), "reaches beyond"),
        (_tensor_of(4, (2,), (-1,), 1), "other things than numbers"),
        (_tensor_of(4, (1 << 28, 1 << 28), (0, 0)), "larger than its storage 0"),
        (_tensor_of(4, (2,), (1, 1)), "other things than numbers"),
        (_tensor_of(4, (1,) * 40, (1,) * 40), "other things than numbers"),
        (_tensor_of(3, (3,), (1,)), "archive/data/0 has 16 bytes; at most 12"),
        (_tensor_of(2**40, (2,), (1,)), "has no key or no size"),
        (_tensor_of(5, (2,), (1,)), "storage 0 has another size than it says"),
        (made.pickled(b"K\x01"), "no dictionary of tensors"),
        (made.pickled(b"}"), "no tensors by name"),
        (made.pickled(b"}" + b")" + b"K\x01s"), "neither text nor a number"),
        (made.pickled(b"X\xff\xff\xff\xff"), "is cut"),
        (made.pickled(b"T\xfb\xff\xff\xff"), "is cut"),
        (made.pickled(b"\x8d" + b"\xff" * 8), "is cut"),
        (made.pickled(b"\x8b\xff\xff\xff\x7f"), "is cut"),
        (made.pickled(b"\x8b\x01\x00\x00\x00\x01"), "opcode LONG4"),
        (made.pickled(b"\x8a\xff" + b"\x7f" * 255), "no dictionary of tensors"),
        (made.pickled(b"I" + b"9" * 5000 + b"\n"), "or damaged"),
        (made.pickled(b"I9\n"), "opcode INT"),
        (made.pickled(b"\x96" + b"\xff" * 8), "is cut"),
        (made.pickled(b"\x96\x01" + bytes(8)), "opcode BYTEARRAY8"),
        (made.pickled(b"h\x05"), "object 5 that it never kept"),
        (made.pickled(b"0"), "opcode"),
        (made.pickled(b"(t" + b"u"), "more from the stack"),
        (made.pickled(b"R"), "more from the stack"),
        (made.pickled(b"}(K\x01u"), "a key has no value"),
        (made.pickled(b"K\x01K\x01K\x01s"), "should be a dict"),
        (made.pickled(b"K\x01K\x01a"), "should be a list"),
        (made.pickled(b"K\x01Q"), "something else than tensors' storages"),
        (b"\x80\x01}.", "pickle protocol is 1"),
        (b"\x80\x02" + b"X\x02\x00\x00\x00\xff\xfe.", "'utf-8' codec can't decode"),
    ],
)
def test_claims_that_do_not_fit_are_refused(tmp_path: Path, pickle: bytes, says: str) -> None:
    line = refused(tmp_path / "w.pth", made.as_zip(pickle, {"0": bytes(16)}))
    assert says in line, line


@pytest.mark.parametrize(
    "pickle",
    [
        made.pickled(b"]r\xff\xff\xff\x7f"),  # the memo of Python's unpickler would take 16 GB
        made.pickled(b"]" * 8_000),
        made.pickled(b"]" + b"](e" * 5_000),
        made.pickled(b")" + b"\x85" * 15_000),
        made.pickled(b"K\x00\x94" + b"h\x00\x86\x94" * 3_000),
        made.pickled(b"(" * 7_500 + b"t" * 7_500),
        made.pickled(b")q\x00" + b"h\x00h\x00\x86q\x00" * 100 + b"}h\x00K\x01s"),
        made.pickled(b"]q\x00" + b"h\x00a" * 5_000),
        made.pickled(b"]" * 25_000),
    ],
    ids=["memo", "many", "lists", "depth", "kept", "marks", "doubling", "itself", "long"],
)
def test_a_small_file_takes_little_memory_whatever_it_claims(
    tmp_path: Path, pickle: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Within a bound for the bytes of a pickle that is a sixty-fourth of the real one."""
    monkeypatch.setattr(pickle_subset, "MOST_BYTES", 1 << 14)
    for data in (made.as_zip(pickle, {}), made.as_legacy(pickle, {})):
        tracemalloc.start()
        try:
            refused(tmp_path / "w.pth", data)
            assert tracemalloc.get_traced_memory()[1] < 4 << 20
        finally:
            tracemalloc.stop()


def test_an_archive_that_would_grow_is_refused(tmp_path: Path) -> None:
    pickle = _tensor_of(1 << 20, (1 << 20,), (1,))
    data = made.as_zip(pickle, {"0": bytes(4 << 20)}, zipfile.ZIP_DEFLATED)
    assert len(data) < 1 << 16
    assert "is compressed, as torch writes none" in refused(tmp_path / "w.pth", data)


def test_many_descriptions_of_nothing_are_refused_before_they_are_read(tmp_path: Path) -> None:
    path = tmp_path / "w.pth"
    crowd = made.as_zip(made.pickled(b"}"), {str(key): b"" for key in range(10_100)})
    assert "the archive has 10103 files; at most 10000" in refused(path, crowd)
    header = (b'{"a":' + b" " * (2 << 20) + b"{}}").ljust(3 << 20)
    long = len(header).to_bytes(8, "little") + header
    assert "it describes its tensors in 3145728 bytes; at most 1048576" in refused(path, long)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "no file of PyTorch or safetensors"),
        (b"\x80\x02}q\x00.", "no file of PyTorch"),
        (b"PK\x03\x04" + bytes(100), "a damaged zip archive"),
        (made.as_zip(b"", {}).replace(b"data.pkl", b"what.pkl"), "none of torch.save"),
        (made.as_zip(_tensor_of(1, (1,), (1,)), {}), "the archive has no archive/data/0"),
        (made.as_zip(b"", {}, byteorder=b"big"), "big-endian"),
        (made.legacy_of(TENSORS) + b"\0", "1 bytes follow the last tensor"),
        (made.as_legacy(b"", {}, machine=made.pickled(b"}")), "big-endian"),
        (made.as_legacy(made.pickled(b"}"), {"9": bytes(4)}), "9 belongs to no tensor"),
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
    with pytest.raises(WeightsError, match="Is a directory"):
        torch_file.read(tmp_path)


def test_a_file_larger_than_any_weights_is_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch_file, "MOST_BYTES", 1 << 20)
    path = tmp_path / "w.pth"
    path.touch()
    os.truncate(path, 1 << 40)
    with pytest.raises(WeightsError, match="more than 1 MB"):
        torch_file.read(path)


def test_integers_and_text_are_pythons_own() -> None:
    """The machine against Python's unpickler, on values that pickle writes."""
    import pickle

    value = {
        "a": [1, 255, 256, 65535, 65536, -1, 2**31, -(2**63), 2**100, 0.1, -1e300],
        "ä€": (True, False, None, (), (1,), (1, 2), (1, 2, 3), (1, 2, 3, 4), [], {}),
        3: {"deep": {"er": ["x" * 300]}},
    }
    for protocol in (2, 3, 4, 5):
        data = pickle.dumps(value, protocol)
        found, end = pickle_subset.load(b"??" + data + b"more", 2, {})
        assert found == value and end == 2 + len(data)
