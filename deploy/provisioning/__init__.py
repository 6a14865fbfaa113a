"""The format of `blimp/blimp.toml` on the boot partition: what one card is told about its world.

The flasher writes it, a person edits it on any laptop, the card reads it at boot. Standard library
only: this package is copied to the card as it is, with `deploy.errors`.
"""
