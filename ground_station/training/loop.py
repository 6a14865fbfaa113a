"""Training from the corpus to the model's file, in steps that a kill can only delay."""

from __future__ import annotations

import signal
import sys
import time
from contextlib import closing, nullcontext
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from ground_station.feature_models.homographic import NEAR_PX, compared
from ground_station.features import catalogue, inspection
from ground_station.features.blobs import BlobFeatures
from ground_station.features.extractor import Extractor
from ground_station.features.extractors import of_network
from ground_station.features.inference import Network
from ground_station.features.methods.rootsift import RootSift
from ground_station.features.settings import LearnedSettings
from ground_station.progress import Progress, stop_noted
from ground_station.training import checkpoint, corpus, curve
from ground_station.training.batches import Source, held_out
from ground_station.training.errors import TrainingError
from ground_station.training.export import export
from ground_station.training.losses import Losses
from ground_station.training.network import FeatureNetwork
from ground_station.training.pairs import Batch
from ground_station.training.recipe import Recipe, finite, is_due
from ground_station.training.topology import OUTPUTS
from ground_station.training.trainer import Trainer
from pi_firmware.wire.errors import os_errors_as

_LOG_EVERY = 25
_HELD_OUT_PAIRS = 48
_MOST_POINTS = 300
"""Key points a held-out view: 1,200 in a picture of 640x480."""
_DIFFERENCE = 1e-4
"""What onnxruntime's outputs may differ from torch's, of the largest."""


@dataclass(frozen=True)
class Machine:
    """What the run has, which changes nothing but the rounding of its results."""

    device: str = "auto"
    threads: int = 2
    jobs: int = 2
    precision: str = "auto"
    """Of the network's arithmetic: bfloat16 on a GPU, else float32. Processors that have bfloat16,
    too, train nearly twice as fast in it."""
    checkpoint_every: int = 250
    validate_every: int = 1000

    def chosen(self) -> torch.device:
        """The device; raises `TrainingError` where there is none."""
        if self.device not in ("auto", "cpu", "cuda"):
            raise TrainingError(f"device is '{self.device:.40}'; allowed: auto, cpu, cuda")
        if self.device == "cuda" and not torch.cuda.is_available():
            raise TrainingError("device is 'cuda', but torch finds no GPU here")
        if self.device == "auto":
            return torch.device("cuda" if torch.cuda.is_available() else "cpu")
        return torch.device(self.device)

    def bfloat16(self) -> bool | None:
        """What the precision says; None: as the device has it. Raises `TrainingError`."""
        known = {"auto": None, "float32": False, "bfloat16": True}
        if self.precision not in known:
            raise TrainingError(f"precision is '{self.precision:.40}'; allowed: {', '.join(known)}")
        return known[self.precision]


def train(
    recipe: Recipe,
    *,
    out: Path,
    corpus_folder: Path,
    machine: Machine,
    resume: bool = False,
    decay_from: Path | None = None,
) -> dict[str, Any]:
    """Runs a recipe in a folder and returns the last figures.

    The folder then holds `checkpoints/`, `log.jsonl`, `curve.png` and the model's file. Raises
    `TrainingError` where it holds a run already and `resume` is not set, or another recipe's.
    """
    device = machine.chosen()
    torch.set_num_threads(machine.threads)
    # Of what is not the network's: places of blobs are differences of neighbouring pixels.
    torch.backends.cudnn.allow_tf32 = False
    cv2.setNumThreads(1)
    checkpoints = out / "checkpoints"
    with os_errors_as(checkpoints, TrainingError):
        checkpoints.mkdir(parents=True, exist_ok=True)
    start = checkpoint.newest(checkpoints)
    if start is not None and not resume:
        raise TrainingError(f"{out} holds a run at step {start.step}; go on with --resume")
    fresh = start is None
    if start is None and decay_from is not None:
        start = checkpoint.read(decay_from)
        recipe = recipe.decaying_from(start.step)
    elif start is not None:
        # A resumed run is as long as it was, whoever asks.
        recipe = recipe.as_long_as(_recipe_of(start))
    trainer = Trainer(recipe, device, machine.bfloat16())
    step, before_s = 0, 0.0
    if start is not None:
        if other := recipe.differences(_recipe_of(start)):
            raise TrainingError(f"the checkpoint is of another recipe: {', '.join(other)} differ")
        trainer.restore(start)
        step, before_s = start.step, float(start.state.get("seconds", 0))
    corpus.make(corpus_folder, recipe.corpus, machine.jobs)
    source = Source(recipe, corpus_folder, device)
    held = held_out(recipe, corpus_folder, _HELD_OUT_PAIRS)
    log = curve.Log(out / "log.jsonl", -1 if fresh else step)
    run = _Run(recipe, trainer, out, machine, before_s, held, log)
    run.begins(step)
    if fresh:
        run.baselines(step)
    return run.go(source, step)


def _recipe_of(start: checkpoint.Checkpoint) -> dict[str, Any]:
    recipe = start.state.get("recipe")
    if not isinstance(recipe, dict):
        raise TrainingError(f"the checkpoint of step {start.step} names no recipe")
    return recipe


class _Run:
    def __init__(
        self, recipe: Recipe, trainer: Trainer, out: Path, machine: Machine, before_s: float,
        held: Batch, log: curve.Log,
    ) -> None:  # fmt: skip
        self.recipe, self.trainer, self.machine, self.held = recipe, trainer, machine, held
        self.out, self.model = out, out / f"{trainer.shape.name}.onnx"
        self.log = log
        self._before_s, self._started_s = before_s, time.monotonic()

    @property
    def seconds(self) -> float:
        """That this run and those that it goes on from took."""
        return self._before_s + time.monotonic() - self._started_s

    def begins(self, step: int) -> None:
        """Notes what goes on from here: a resumed run may have a larger corpus."""
        self.log.add(
            "recipe", step=step, recipe=self.recipe.as_dict(),
            device=str(self.trainer.device), bfloat16=self.trainer.bfloat16,
        )  # fmt: skip

    def baselines(self, step: int) -> None:
        """What others make of the same held-out pairs."""
        wren = Network(catalogue.find("wren"), threads=self.machine.threads)
        others: dict[str, Extractor] = {
            "rootsift": RootSift(_MOST_POINTS), "wren": of_network(wren, _MOST_POINTS)
        }  # fmt: skip
        for name, extractor in others.items():
            figures = figures_of(extractor, self.held)
            self.log.add("baseline", step=step, name=name, **asdict(figures))
            _log(name, figures)

    def go(self, source: Source, step: int) -> dict[str, Any]:
        """The steps that are left; an interrupt ends them after a checkpoint."""
        recipe, machine, log = self.recipe, self.machine, self.log
        names = [field.name for field in fields(Losses)]
        sums = torch.zeros(len(names), device=self.trainer.device)
        count, since_s, written = 0, time.monotonic(), step
        stream = source.batches(step, recipe.steps, machine.jobs)
        # A log has lines enough of its own.
        bar = Progress("steps", recipe.steps - step) if sys.stderr.isatty() else nullcontext()
        with stop_noted(signal.SIGINT, signal.SIGTERM) as stopped, bar, closing(stream):
            for batch in stream:
                made = self.trainer.step(step, batch)
                # Read only where it is logged: a GPU would wait for each number.
                sums += torch.stack([getattr(made, name).detach() for name in names])
                count, step = count + 1, step + 1
                if isinstance(bar, Progress):
                    bar.step()
                if is_due(step, _LOG_EVERY, recipe.steps):
                    means, now_s = (sums / count).tolist(), time.monotonic()
                    values = {n: round(finite(v), 5) for n, v in zip(names, means, strict=True)}
                    rate = 2 * recipe.batch * count / (now_s - since_s)
                    log.add(
                        "train", step=step, **values, rate=recipe.rate_at(step - 1),
                        images_per_s=round(rate, 2), seconds=round(self.seconds, 1),
                    )  # fmt: skip
                    if is_due(step, 8 * _LOG_EVERY, recipe.steps):
                        text = " ".join(f"{k} {v:.3f}" for k, v in values.items())
                        print(f"step {step}: {text}, {rate:.1f} images/s", file=sys.stderr)
                    sums, count, since_s = torch.zeros_like(sums), 0, now_s
                if is_due(step, machine.checkpoint_every, recipe.steps) or stopped[0]:
                    self.save(step)
                    written = step
                if stopped[0]:
                    break
                if step % machine.validate_every == 0 and step < recipe.steps:
                    self.validate(step)
                    since_s = time.monotonic()
        if written != step:
            self.save(step)
        return self.validate(step)

    def save(self, step: int) -> None:
        """A checkpoint, unless training has run away: then the last one stays the last."""
        finite(float(sum(p.detach().abs().sum() for p in self.trainer.network.parameters())))
        state = {"recipe": self.recipe.as_dict(), "seconds": self.seconds}
        checkpoint.write(
            self.out / "checkpoints", self.trainer.checkpoint(step, state),
            keep_every=20 * self.machine.checkpoint_every,
        )  # fmt: skip

    def validate(self, step: int) -> dict[str, Any]:
        """Exports the weights' mean, holds the file to torch's outputs, and judges it."""
        pairs = self.recipe.batch * step
        source = f"blimp models train, seed {self.recipe.seed}, {pairs} pairs"
        weights, shape = self.trainer.weights(), self.trainer.shape
        export(shape, weights, self.model, source)
        network = Network(inspection.read(self.model), threads=self.machine.threads)
        self.compare(network)
        extractor = BlobFeatures(network, _MOST_POINTS, LearnedSettings())
        figures = figures_of(extractor, self.held)
        _log(f"step {step}", figures)
        values = asdict(figures)
        self.log.add("validation", step=step, **values, seconds=round(self.seconds, 1))
        curve.plot(self.log.path, self.out / "curve.png")
        return {"model": str(self.model), "step": step, "steps": self.recipe.steps, "pairs": pairs,
                "seconds": round(self.seconds, 1), **values}  # fmt: skip

    def compare(self, network: Network) -> None:
        """Raises `TrainingError` where the file does not say what torch says."""
        with torch.random.fork_rng(devices=[]):  # the first weights are drawn for nothing
            mean = FeatureNetwork(self.trainer.shape)
        mean.load_state_dict({k: v.cpu() for k, v in self.trainer.mean.items()})
        mean.eval()
        image = self.held.images[:1]
        with torch.no_grad():
            wanted = mean(image)
        said = network.run(image.numpy())
        for name, ours in zip(OUTPUTS, wanted, strict=True):
            gap = float(np.abs(said[name] - ours.numpy()).max())
            if not gap <= _DIFFERENCE * max(1.0, float(ours.abs().max())):
                raise TrainingError(f"{self.model}: its {name} differ from torch's by {gap:.2g}")


@dataclass(frozen=True)
class Figures:
    """Means over pairs: `accuracy` the share of mutual nearest matches that are within 3 px,
    `correct` their number; `repeatability` the share of key points in both views' common part that
    lie within 3 px of one of the other's; `error_px` their median distance."""

    accuracy: float
    correct: float
    repeatability: float
    error_px: float


def figures_of(extractor: Extractor, pairs: Batch) -> Figures:
    """How well an extractor finds a view's key points again in the other; no lens may bend them.

    See `feature_models.homographic` for what counts as a match.
    """
    images = (pairs.images[:, 0] * 255).round().to(torch.uint8).numpy()
    matrices = (pairs.views.from_picture[1::2] @ pairs.views.to_picture[::2]).double().numpy()
    found = [
        compared(extractor, images[2 * k], images[2 * k + 1], matrix / matrix[2, 2])
        for k, matrix in enumerate(matrices)
    ]
    pooled = np.concatenate([each.nearest_px for each in found])
    pooled = pooled[pooled <= NEAR_PX]
    return Figures(
        accuracy=float(np.mean([each.accuracy for each in found])),
        correct=float(np.mean([each.correct for each in found])),
        repeatability=float(np.mean([each.repeatability for each in found])),
        error_px=float(np.median(pooled)) if len(pooled) else float("nan"),
    )


def _log(name: str, figures: Figures) -> None:
    print(
        f"{name}: {100 * figures.accuracy:.1f} % of matches within 3 px ({figures.correct:.0f} a "
        f"pair), repeatability {100 * figures.repeatability:.1f} %, {figures.error_px:.2f} px",
        file=sys.stderr,
    )
