"""Made-up weights for the tests of training."""

import numpy as np

from ground_station.training.topology import Shape, layers


def weights(shape: Shape, seed: int = 0) -> dict[str, np.ndarray]:
    """Random weights of a shape, about as large as a start of training's."""
    rng = np.random.default_rng(seed)
    made: dict[str, np.ndarray] = {}
    for layer in layers(shape):
        n, m, k = layer.channels_out, layer.channels_in, layer.size
        made[f"{layer.name}.weight"] = rng.normal(0, (2 / (m * k * k)) ** 0.5, (n, m, k, k))
        if layer.norm:
            made[f"{layer.name}.norm.weight"] = rng.uniform(0.5, 1.5, n)
            made[f"{layer.name}.norm.bias"] = rng.normal(0, 0.2, n)
            made[f"{layer.name}.norm.mean"] = rng.normal(0, 0.2, n)
            made[f"{layer.name}.norm.var"] = rng.uniform(0.5, 2, n)
        else:
            made[f"{layer.name}.bias"] = rng.normal(0, 0.2, n)
    return {name: value.astype(np.float32) for name, value in made.items()}
