"""The run itself: checkpoints, the command's refusals, and, with torch, that a killed run goes on
as if nothing had been and that the file says what torch says."""

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ground_station.training import checkpoint, command, curve
from ground_station.training.checkpoint import Checkpoint
from ground_station.training.corpus import CorpusSettings
from ground_station.training.errors import TrainingError
from ground_station.training.recipe import Recipe

CORPUS = CorpusSettings(seed=3, rooms=0, rows=128, columns=160)
TINY = Recipe(
    corpus=CORPUS, textures=32, first_textures=16, fresh=6, rows=64, columns=96, batch=2,
    points=16, steps=6, warm_up=2, decay=2,
)  # fmt: skip


def arguments(*given: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    return parser.parse_args(given)


def test_without_torch_one_line_says_how_to_get_it(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(TrainingError) as raised:
        command.run(arguments("--out", str(tmp_path / "run")))
    assert "pip install" in str(raised.value) and "\n" not in str(raised.value)
    assert not (tmp_path / "run").exists()


def test_the_rate_goes_up_stays_and_ends_at_nought_wherever_it_branches_off():
    recipe = Recipe(steps=1000, warm_up=100, decay=200, rate=1e-3)
    rates = np.array([recipe.rate_at(k) for k in range(1000)])
    assert (np.diff(rates[:100]) > 0).all()
    assert (rates[100:799] == 1e-3).all()
    assert (np.diff(rates[801:]) < 0).all() and 0 < rates[-1] < 1e-5
    branch = recipe.decaying_from(400)
    assert branch.steps == 600
    assert branch.rate_at(399) == 1e-3 and 0 < branch.rate_at(599) < 1e-5
    assert not recipe.differences(branch.as_dict())
    assert recipe.differences(replace(recipe, batch=9).as_dict()) == ["batch"]
    assert recipe.differences({"size": "lark"})[-1] == "corpus"
    assert recipe.as_long_as(branch.as_dict()).steps == 600


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"size": "huge"}, "size is 'huge'; there are: lark"),
        ({"rate": float("nan")}, "rate is nan; allowed: 1e-07 to 1"),
        ({"batch": 0}, "batch is 0; allowed: 1 to 4096"),
        ({"columns": 100}, "multiples of 16"),
        ({"rows": 512}, "larger than the corpus' pictures"),
    ],
)
def test_a_recipe_that_trains_nothing_is_refused(change, line):
    with pytest.raises(TrainingError) as raised:
        replace(Recipe(), **change)
    assert line in str(raised.value) and "\n" not in str(raised.value)


def some(step: int) -> Checkpoint:
    arrays = {"a": np.arange(step, dtype=np.float32), "b": np.array(3.0, np.float32)}
    return Checkpoint(step, arrays, {"step": step})


def test_checkpoints_come_back_and_a_damaged_one_gives_way_to_the_one_before(tmp_path):
    assert checkpoint.newest(tmp_path) is None
    for step in (10, 20, 30, 40, 50):
        path = checkpoint.write(tmp_path, some(step), keep_every=20)
    # The last three, and those at whole multiples for branches.
    assert [step for step, _ in checkpoint.steps(tmp_path)] == [20, 30, 40, 50]
    newest = checkpoint.newest(tmp_path)
    assert newest is not None and newest.step == 50 and newest.state == {"step": 50}
    assert (newest.arrays["a"] == np.arange(50)).all() and newest.arrays["b"].shape == ()
    damaged = bytearray(path.read_bytes())
    damaged[-5] ^= 1
    path.write_bytes(damaged)
    with pytest.raises(TrainingError, match="checksum"):
        checkpoint.read(path)
    before = checkpoint.newest(tmp_path)
    assert before is not None and before.step == 40
    (tmp_path / "step-0000060.safetensors").write_bytes(b"")  # cut
    assert checkpoint.newest(tmp_path).step == 40  # type: ignore[union-attr]
    with pytest.raises(TrainingError, match="is called step-"):
        checkpoint.read(tmp_path / "elsewhere.safetensors")


def test_a_resumed_log_forgets_what_will_be_done_again(tmp_path):
    path = tmp_path / "log.jsonl"
    log = curve.Log(path, 0)
    for step in (1, 2, 3):
        log.add("train", step=step)
    with path.open("a") as file:
        file.write('{"kind": "tra')  # killed in the middle of a line
    curve.Log(path, 2).add("train", step=3, again=True)
    assert [line["step"] for line in curve.read(path)] == [1, 2, 3]
    assert curve.read(path)[-1]["again"] is True
    assert json.loads(path.read_text().splitlines()[0])["step"] == 1


# From here on torch is needed, which the project's own environment has not.


@pytest.fixture(scope="module")
def torch():
    return pytest.importorskip("torch", reason="training's tests need torch, an optional extra")


@pytest.fixture(scope="module")
def made(torch, tmp_path_factory) -> Path:
    """The folder of a corpus without rooms."""
    return tmp_path_factory.mktemp("corpus") / "corpus"


def train(made: Path, out: Path, recipe: Recipe = TINY, precision: str = "auto", **options):
    from ground_station.training.loop import Machine
    from ground_station.training.loop import train as run

    machine = Machine(
        "cpu", threads=1, jobs=0, precision=precision, checkpoint_every=2, validate_every=4
    )
    return run(recipe, out=out, corpus_folder=made, machine=machine, **options)


def last(out: Path) -> Checkpoint:
    found = checkpoint.newest(out / "checkpoints")
    assert found is not None
    return found


@pytest.fixture(scope="module")
def straight(made, tmp_path_factory) -> Path:
    """A run that nothing cut."""
    out = tmp_path_factory.mktemp("straight")
    result = train(made, out)
    assert result["step"] == 6
    return out


def test_a_run_leaves_model_log_and_curve(straight):
    lines = curve.read(straight / "log.jsonl")
    kinds = [line["kind"] for line in lines]
    assert kinds.count("baseline") == 2 and "validation" in kinds and "train" in kinds
    assert (straight / "lark.onnx").stat().st_size > 500_000
    assert (straight / "curve.png").stat().st_size > 5000


@pytest.mark.parametrize("at", [1, 3, 4])
def test_a_killed_run_goes_on_to_the_same_weights(made, straight, tmp_path, monkeypatch, at):
    from ground_station.training.trainer import Trainer

    step = Trainer.step

    class Killed(Exception):
        """Nothing is done after it, as after SIGKILL."""

    def dies(self, number, batch):
        if number == at:
            raise Killed
        return step(self, number, batch)

    monkeypatch.setattr(Trainer, "step", dies)
    with pytest.raises(Killed):
        train(made, tmp_path / "run")
    monkeypatch.undo()
    if at > 1:  # before the first checkpoint there is nothing to go on from
        with pytest.raises(TrainingError, match="--resume"):
            train(made, tmp_path / "run")
    train(made, tmp_path / "run", resume=True)
    ours, theirs = last(tmp_path / "run"), last(straight)
    assert ours.arrays.keys() == theirs.arrays.keys()
    for name, array in theirs.arrays.items():
        assert array.tobytes() == ours.arrays[name].tobytes(), name
    model = "lark.onnx"
    assert (tmp_path / "run" / model).read_bytes() == (straight / model).read_bytes()


def test_arithmetic_of_fewer_bits_trains_the_same_weights_but_for_their_last_digits(
    made, straight, tmp_path
):
    train(made, tmp_path / "run", precision="bfloat16")
    ours, theirs = last(tmp_path / "run"), last(straight)
    names = [name for name in theirs.arrays if name.startswith("network.")]
    assert all(ours.arrays[name].dtype == theirs.arrays[name].dtype for name in names)
    weights = [name for name in names if theirs.arrays[name].ndim == 4]
    off = [np.abs(ours.arrays[name] - theirs.arrays[name]).max() for name in weights]
    assert 0 < max(off) < 2.5 * TINY.rate * TINY.steps  # as far as so many steps can go
    log = curve.read(tmp_path / "run" / "log.jsonl")
    assert [line["bfloat16"] for line in log if line["kind"] == "recipe"] == [True]
    with pytest.raises(TrainingError, match="precision is 'half'; allowed: auto, float32"):
        train(made, tmp_path / "other", precision="half")


def test_another_recipe_does_not_go_on(made, straight):
    with pytest.raises(TrainingError, match="another recipe: batch differ"):
        train(made, straight, replace(TINY, batch=3), resume=True)


def test_a_branch_ends_a_run_from_any_checkpoint(made, straight, tmp_path):
    kept = checkpoint.steps(straight / "checkpoints")[0]
    result = train(made, tmp_path / "end", decay_from=kept[1])
    assert result["step"] == kept[0] + TINY.decay
    log = [line for line in curve.read(tmp_path / "end" / "log.jsonl") if line["kind"] == "train"]
    assert log[-1]["rate"] < TINY.rate / 2


def test_the_file_says_what_torch_says(torch, tmp_path):
    from ground_station.features import inspection
    from ground_station.features.inference import Network
    from ground_station.training import export
    from ground_station.training.network import FeatureNetwork, exported
    from ground_station.training.topology import OUTPUTS, SHAPES

    torch.manual_seed(1)
    network = FeatureNetwork(SHAPES["lark"])
    image = torch.rand(2, 1, 64, 96)
    for _ in range(3):  # so that the normalisations have seen something
        network(image)
    network.eval()
    path = tmp_path / "x.onnx"
    shape = SHAPES["lark"]
    export.export(shape, exported(shape, network.state_dict()), path, "a test")
    said = Network(inspection.read(path)).run(image.numpy())
    with torch.no_grad():
        wanted = network(image)
    for name, ours in zip(OUTPUTS, wanted, strict=True):
        scale = max(1.0, float(ours.abs().max()))
        assert np.abs(said[name] - ours.numpy()).max() <= 1e-4 * scale
