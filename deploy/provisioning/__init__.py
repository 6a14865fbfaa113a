"""The format of `blimp/blimp.toml` on the boot partition: what one card is told about its world.

The flasher writes it, a person edits it on any laptop, the card reads it at boot. Standard library
only: this package is copied to the card as it is, with `deploy.errors`.
"""

from deploy.provisioning.model import (
    GroundStation,
    Provisioning,
    Wifi,
    keeps_password,
    without_secrets,
)
from deploy.provisioning.text import parse, render
from deploy.provisioning.wpa import wpa_supplicant_conf

__all__ = [
    "GroundStation",
    "Provisioning",
    "Wifi",
    "keeps_password",
    "parse",
    "render",
    "without_secrets",
    "wpa_supplicant_conf",
]
