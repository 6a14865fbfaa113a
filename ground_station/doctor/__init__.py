"""`blimp doctor`: what the ground station needs of its machine, and how to fix what is not so."""

from pathlib import Path

ROOT = Path(__file__).parents[2]
"""The checkout or the installed release."""
