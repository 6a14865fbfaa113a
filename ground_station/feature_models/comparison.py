"""A variant of a model beside the model: what it loses in matching accuracy, what it takes."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ground_station.arrays import U8
from ground_station.feature_models import homographic
from ground_station.feature_models.homographic import Matching
from ground_station.features.extractors import of_network
from ground_station.features.inference import Network, network_input
from ground_station.features.model_info import Model
from ground_station.progress import Progress
from ground_station.recording.frames import FrameSource

MAX_FEATURES = 1000
_TIMED = 15


@dataclass(frozen=True)
class Comparison:
    """Both in one run; `ms` is the median time of the network for the first picture."""

    reference: Matching
    variant: Matching
    reference_ms: float
    variant_ms: float
    shape: tuple[int, ...]
    pairs: int

    @property
    def time_ratio(self) -> float:
        """The variant's time for the model's."""
        return self.variant_ms / self.reference_ms


def compare(
    reference: Model, variant: Model, images: Sequence[U8], threads: int, seed: int
) -> Comparison:
    """Matches each picture (H, W) uint8 with a warp of it, and runs both in turn for the time."""
    networks = [Network(model, threads=threads) for model in (reference, variant)]
    random = np.random.default_rng(seed)
    pairs = [(image, *homographic.warp(image, random)) for image in images]
    of_reference, of_variant = (
        homographic.matching(of_network(network, MAX_FEATURES), pairs) for network in networks
    )
    times: list[list[float]] = [[], []]
    blob = network_input(reference.info, images[0])
    # In turn, so that what else the machine does is in both.
    for _ in range(_TIMED):
        for network, taken in zip(networks, times, strict=True):
            began = time.perf_counter()
            network.run(blob)
            taken.append((time.perf_counter() - began) * 1e3)
    reference_ms, variant_ms = (float(np.median(taken)) for taken in times)
    return Comparison(
        of_reference, of_variant, reference_ms, variant_ms, images[0].shape, len(pairs)
    )


def evenly(source: FrameSource, count: int) -> list[U8]:
    """`count` pictures of an input, evenly over it; all where it has no more.

    In one pass and with memory for twice as many: when these are full, every second goes.
    """
    kept: list[U8] = []
    step = 1
    with Progress("frames", source.count()) as progress:
        for number, frame in enumerate(source):
            progress.step()
            if number % step:
                continue
            kept.append(frame.image)
            if len(kept) >= 2 * count:
                kept = kept[::2]
                step *= 2
    places = np.linspace(0, len(kept) - 1, min(count, len(kept))).round().astype(int)
    return [kept[place] for place in places]
