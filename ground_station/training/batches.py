"""The places that a step may draw from: rooms, and textures that come and go as training runs.

Other processes paint the textures; the teacher labels them on the device. What is there at a step
follows from seed and step, so that a resumed run sees what it would have seen.
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
from ground_station.training.teacher import Teacher
from ground_station.training.views import Chance

_GROUP = 16
"""Textures that are painted and labelled together."""
_AHEAD = 2
"""Groups that each process has ready."""
_TURNS = 8
"""Turned pictures that the teacher sees of each place, beside those as they are."""
_POINTS = 600
_LABELLED = 8
"""Places that the teacher looks at together: it takes half a gigabyte for them."""


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

    def __init__(
        self, recipe: Recipe, teacher: Teacher, folder: Path, device: torch.device
    ) -> None:
        self._recipe, self._teacher, self._device = recipe, teacher, device
        size = (recipe.corpus.rows, recipe.corpus.columns)
        rooms = [corpus.read(folder, k, size) for k in range(recipe.corpus.rooms - 1)]
        self._rooms = sum(len(room) for room in rooms)
        most = self._rooms + recipe.textures
        self._places = Places(
            torch.empty(LIGHTS * self._rooms + recipe.textures, *size, dtype=torch.uint8,
                        device=device),
            torch.zeros(most, 2, dtype=torch.int64, device=device),
            torch.zeros(most, _POINTS, 2, device=device),
            torch.zeros(most, _POINTS, device=device),
        )  # fmt: skip
        first = 0
        for number, room in enumerate(rooms):
            views = torch.from_numpy(room)
            self._put(first, LIGHTS * first, views, Chance(device, recipe.seed, 1, number))
            first += len(views)

    def _put(self, place: int, picture: int, views: Tensor, chance: Chance) -> None:
        """Pictures (N, L, H, W) of N places, from that one on."""
        views = views.to(self._device)
        count, lights = views.shape[:2]
        numbers = picture + torch.arange(count * lights, device=self._device).view(count, lights)
        rows = slice(place, place + count)
        p = self._places
        p.pictures[picture : picture + count * lights] = views.flatten(0, 1)
        p.lights[rows] = numbers[:, [0, -1]]
        for k in range(0, count, _LABELLED):
            part = slice(place + k, place + min(k + _LABELLED, count))
            p.points_px[part], p.scores[part] = self._teacher.label(
                views[k : k + _LABELLED].float() / 255, _TURNS, _POINTS, chance
            )

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
                slot = (group % most) * _GROUP
                chance = Chance(self._device, recipe.seed, 2, group)
                self._put(self._rooms + slot, LIGHTS * self._rooms + slot,
                          next(stream)[:, None], chance)  # fmt: skip
                group += 1
            there = self._rooms + min(group, most) * _GROUP
            p = self._places
            places = Places(p.pictures, p.lights[:there], p.points_px[:there], p.scores[:there])
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
    places = Places(
        views.flatten(0, 1), torch.arange(2 * total).view(total, 2), torch.zeros(total, 8, 2),
        torch.zeros(total, 8),
    )  # fmt: skip
    chance = Chance(torch.device("cpu"), seed)
    return pairs.make(places, chance, count, (recipe.rows, recipe.columns), 16, lens=False)
