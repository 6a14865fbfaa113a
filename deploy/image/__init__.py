"""Builds the whole card as a file: `python -m deploy.image --board qemu`, nothing mounted."""
