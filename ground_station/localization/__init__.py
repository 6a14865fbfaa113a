"""From a frame and a map to a pose."""
