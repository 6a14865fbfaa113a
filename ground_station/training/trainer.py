"""The network, its optimizer and the mean of its weights: what a step changes and a file keeps."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils import clip_grad_norm_

from ground_station.training.checkpoint import Arrays, Checkpoint
from ground_station.training.errors import TrainingError
from ground_station.training.export import Weights
from ground_station.training.losses import Losses, LossSettings, losses
from ground_station.training.network import FeatureNetwork, exported
from ground_station.training.pairs import Batch
from ground_station.training.recipe import Recipe
from ground_station.training.topology import shape_of

_MOST_GRADIENT = 5.0
_MOMENTS = ("exp_avg", "exp_avg_sq", "step")
"""AdamW's state of each parameter (Loshchilov and Hutter, ICLR 2019)."""


class Trainer:
    """Deterministic on a CPU with the same number of threads."""

    def __init__(self, recipe: Recipe, device: torch.device, bfloat16: bool | None = None) -> None:
        """`bfloat16`: the network computes in it; None: on a GPU it does."""
        torch.manual_seed(recipe.seed)
        self.recipe, self.device = recipe, device
        self.bfloat16 = device.type == "cuda" if bfloat16 is None else bfloat16
        self.shape = shape_of(recipe.size)
        self.network = FeatureNetwork(self.shape).to(device, memory_format=torch.channels_last)
        self.network.train()
        self.optimizer = torch.optim.AdamW(
            self.network.parameters(), lr=recipe.rate, weight_decay=recipe.weight_decay
        )
        self.mean = {
            name: value.detach().clone() for name, value in self.network.state_dict().items()
        }
        self._settings = LossSettings()

    def step(self, number: int, batch: Batch) -> Losses:
        """One step on one batch; the weights are then those for step `number` + 1."""
        for group in self.optimizer.param_groups:
            group["lr"] = self.recipe.rate_at(number)
        images = batch.images.contiguous(memory_format=torch.channels_last)
        # It has float32's range, so that no loss needs scaling.
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.bfloat16):
            outputs = self.network(images)
        result = losses(outputs, batch, self._settings)
        self.optimizer.zero_grad(set_to_none=True)
        result.total.backward()
        clip_grad_norm_(self.network.parameters(), _MOST_GRADIENT)
        self.optimizer.step()
        self._update_mean(number)
        return result

    @torch.no_grad()
    def _update_mean(self, number: int) -> None:
        keep = min(self.recipe.average, (1 + number) / (10 + number))
        for name, value in self.network.state_dict().items():
            if value.is_floating_point():
                self.mean[name].lerp_(value, 1 - keep)
            else:
                self.mean[name].copy_(value)

    def weights(self) -> Weights:
        """The mean of the weights, as `export` takes them."""
        return exported(self.shape, self.mean)

    def checkpoint(self, step: int, state: dict[str, Any]) -> Checkpoint:
        """All that the next step depends on, and the random state beside it."""
        arrays: dict[str, np.ndarray] = {"torch_rng": torch.get_rng_state().numpy()}
        if self.device.type == "cuda":
            arrays["cuda_rng"] = torch.cuda.get_rng_state(self.device).numpy()
        for name, value in self.network.state_dict().items():
            arrays[f"network.{name}"] = _array(value)
            arrays[f"mean.{name}"] = _array(self.mean[name])
        for k, moments in self.optimizer.state_dict()["state"].items():
            for name in _MOMENTS:
                arrays[f"optimizer.{k}.{name}"] = _array(moments[name])
        return Checkpoint(step, arrays, state)

    def restore(self, checkpoint: Checkpoint) -> None:
        """Goes back to a checkpoint; raises `TrainingError` where it is another network's."""
        arrays = checkpoint.arrays
        state = {name: _taken(arrays, f"network.{name}", value)
                 for name, value in self.network.state_dict().items()}  # fmt: skip
        self.network.load_state_dict(state)
        self.mean = {
            name: _taken(arrays, f"mean.{name}", value).clone() for name, value in self.mean.items()
        }
        whole = self.optimizer.state_dict()
        parameters = list(self.network.parameters())
        whole["state"] = {}
        for k, parameter in enumerate(parameters):
            if f"optimizer.{k}.step" not in arrays:
                break  # before the first step there are none
            whole["state"][k] = {
                name: _taken(arrays, f"optimizer.{k}.{name}",
                             torch.zeros(()) if name == "step" else parameter.detach())
                for name in _MOMENTS
            }  # fmt: skip
        self.optimizer.load_state_dict(whole)
        if "torch_rng" in arrays:
            torch.set_rng_state(torch.from_numpy(np.array(arrays["torch_rng"])))
        if self.device.type == "cuda" and "cuda_rng" in arrays:
            torch.cuda.set_rng_state(torch.from_numpy(np.array(arrays["cuda_rng"])), self.device)


def _array(value: Tensor) -> np.ndarray:
    return np.array(value.detach().cpu().contiguous().numpy())


def _taken(arrays: Arrays, name: str, like: Tensor) -> Tensor:
    if name not in arrays or arrays[name].shape != tuple(like.shape):
        raise TrainingError(f"the checkpoint's '{name}' is missing or of another shape")
    made = torch.from_numpy(np.array(arrays[name])).to(like.device, like.dtype)
    return made.contiguous(memory_format=torch.channels_last) if made.dim() == 4 else made
