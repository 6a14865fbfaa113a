"""Judging where structure from motion put the images: by the chain of neighbours in time."""
