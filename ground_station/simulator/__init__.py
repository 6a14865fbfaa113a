"""Flights with exact ground truth, simulated."""
