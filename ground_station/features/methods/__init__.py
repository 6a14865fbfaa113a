"""Extractors without a model, a file each, found by its name: `METHOD` makes one."""
