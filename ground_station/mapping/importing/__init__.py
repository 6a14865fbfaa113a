"""COLMAP models of others become maps: `blimp map import`."""
