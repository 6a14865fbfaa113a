"""Experiments: what the thesis claims and what it could not ask, flown again with exact truth."""
