"""Batches of pairs as tensors, made by other processes while the network trains."""

from __future__ import annotations

import os
import signal
from collections.abc import Generator
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from ground_station.training.pairs import PairSource

_AHEAD = 2
"""Batches that each process has ready."""
_ARRAYS = ("images", "labels", "known", "points_px", "used", "teacher", "second_from_first")


@dataclass(frozen=True)
class Batch:
    """As the losses take it: views of pair b are in rows 2b and 2b + 1."""

    images: Tensor
    labels: Tensor
    known: Tensor
    points_px: Tensor
    used: Tensor
    teacher: Tensor
    second_from_first: Tensor


class _Steps(Dataset[tuple[Tensor, ...]]):
    """One item a step, from `first` on."""

    def __init__(self, source: PairSource, batch: int, first: int, last: int) -> None:
        self._source, self._batch, self._first, self._last = source, batch, first, last

    def __len__(self) -> int:
        return self._last - self._first

    def __getitem__(self, index: int) -> tuple[Tensor, ...]:
        pairs = [self._source.pair(self._first + index, k) for k in range(self._batch)]
        return tuple(
            torch.from_numpy(np.stack([getattr(pair, name) for pair in pairs])) for name in _ARRAYS
        )


def _start(_: int) -> None:
    """In a process that makes data: Ctrl-C, or a stop of all, is for the one that trains.

    It writes a checkpoint then and ends these itself, by SIGTERM at the latest: they keep that, and
    leave its process group.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.setpgid(0, 0)
    cv2.setNumThreads(1)


def batches(
    source: PairSource, batch: int, first: int, last: int, jobs: int, device: torch.device
) -> Generator[Batch, None, None]:
    """The batches of steps `first` to `last` - 1, in order, on the device."""
    on_gpu = device.type == "cuda"
    loader = DataLoader(
        _Steps(source, batch, first, last),
        batch_size=None,
        num_workers=jobs,
        multiprocessing_context="spawn" if jobs else None,
        prefetch_factor=_AHEAD if jobs else None,
        pin_memory=on_gpu,
        worker_init_fn=_start,
        generator=torch.Generator(),  # not the one whose state checkpoints keep
    )
    for items in loader:
        images, labels, known, points_px, used, teacher, second_from_first = (
            item.to(device, non_blocking=on_gpu) for item in items
        )
        yield Batch(
            images=images.flatten(0, 1)[:, None].float().mul_(1 / 255),
            labels=labels.flatten(0, 1).float(),
            known=known.flatten(0, 1).float(),
            points_px=points_px,
            used=used,
            teacher=teacher.float(),
            second_from_first=second_from_first.float(),
        )
