"""The places that a step may draw from: rooms, and textures that come and go as training runs.

Other processes paint the textures. What is there at a step follows from seed and step, so that a
resumed run sees what it would have seen.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Generator
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from ground_station.arrays import U8
from ground_station.feature_models import images
from ground_station.training import corpus, pairs
from ground_station.training.corpus import LIGHTS
from ground_station.training.pairs import Batch, Places
from ground_station.training.recipe import Recipe
from ground_station.training.views import Chance

_GROUP = 16
"""Textures that are painted together."""
_AHEAD = 2
"""Groups that each process has ready."""


class _Textures(Dataset[Tensor]):
    """Groups `first` to `last` - 1 of a seed's textures."""

    def __init__(self, seed: int, size: tuple[int, int], first: int, last: int) -> None:
        self._seed, self._size, self._first, self._last = seed, size, first, last

    def __len__(self) -> int:
        return self._last - self._first

    def __getitem__(self, index: int) -> Tensor:
        return torch.from_numpy(texture_group(self._seed, self._first + index, self._size))


def texture_group(seed: int, group: int, size: tuple[int, int]) -> U8:
    """Textures (16, rows, columns) of one group."""
    numbers = range(group * _GROUP, (group + 1) * _GROUP)
    return np.stack([images.procedural(seed, number, size) for number in numbers])


def _start(_: int) -> None:
    """In a process that makes data: Ctrl-C, or a stop of all, is for the one that trains.

    It writes a checkpoint then and ends these itself, by SIGTERM at the latest: they keep that, and
    leave its process group.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.setpgid(0, 0)
    cv2.setNumThreads(1)


class Source:
    """The places, in the device's memory."""

    def __init__(self, recipe: Recipe, folder: Path, device: torch.device) -> None:
        self._recipe, self._device = recipe, device
        size = (recipe.corpus.rows, recipe.corpus.columns)
        rooms = [corpus.read(folder, k, size) for k in range(recipe.corpus.rooms - 1)]
        self._rooms = sum(len(room) for room in rooms)
        lit = LIGHTS * self._rooms
        self._pictures = torch.empty(lit + recipe.textures, *size, dtype=torch.uint8, device=device)
        if rooms:
            views = torch.from_numpy(np.concatenate(rooms))
            self._pictures[:lit] = views.flatten(0, 1).to(device)
        # A texture is there in one light.
        numbers = torch.arange(lit + recipe.textures, device=device)
        self._lights = torch.cat([numbers[:lit].view(-1, 2), numbers[lit:, None].expand(-1, 2)])

    def batches(self, first: int, last: int, jobs: int) -> Generator[Batch, None, None]:
        """Those of steps `first` to `last` - 1, in order."""
        recipe = self._recipe
        size = (recipe.corpus.rows, recipe.corpus.columns)
        most = recipe.textures // _GROUP
        now = self._groups_at(first)
        oldest = max(0, now - most)
        stream = iter(DataLoader(
            _Textures(recipe.seed, size, oldest, self._groups_at(last)),
            batch_size=None, num_workers=jobs,
            multiprocessing_context="spawn" if jobs else None,
            prefetch_factor=_AHEAD if jobs else None, worker_init_fn=_start,
            generator=torch.Generator(),  # not the one whose state checkpoints keep
        ))  # fmt: skip
        group = oldest
        for step in range(first, last):
            while group < self._groups_at(step):
                slot = LIGHTS * self._rooms + (group % most) * _GROUP
                self._pictures[slot : slot + _GROUP] = next(stream).to(self._device)
                group += 1
            there = self._rooms + min(group, most) * _GROUP
            places = Places(self._pictures, self._lights[:there])
            chance = Chance(self._device, recipe.seed, 3, step)
            yield pairs.make(
                places, chance, recipe.batch, (recipe.rows, recipe.columns), recipe.points
            )

    def _groups_at(self, step: int) -> int:
        """How many groups of textures had come before a step."""
        return (self._recipe.first_textures + self._recipe.fresh * step) // _GROUP


def held_out(recipe: Recipe, folder: Path, count: int) -> Batch:
    """Pairs of places that training never sees: other textures, and the last room. On the CPU."""
    size = (recipe.corpus.rows, recipe.corpus.columns)
    seed = recipe.seed + 1_000_003
    kinds = [texture_group(seed, k, size)[:, None].repeat(LIGHTS, 1) for k in range(2)]
    if recipe.corpus.rooms:
        kinds.append(corpus.read(folder, recipe.corpus.rooms - 1, size))
    views = torch.from_numpy(np.concatenate(kinds))
    total = len(views)
    places = Places(views.flatten(0, 1), torch.arange(2 * total).view(total, 2))
    chance = Chance(torch.device("cpu"), seed)
    return pairs.make(places, chance, count, (recipe.rows, recipe.columns), 16, lens=False)
