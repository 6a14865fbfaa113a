"""From a model's coordinates to the world's."""
