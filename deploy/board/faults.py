"""What can be wrong with a card, as the light tells it and STATUS.txt says it: one table."""

from __future__ import annotations

from typing import NamedTuple


class Fault(NamedTuple):
    """`blinks` short ones and a pause; `fix` is what a person can do about it."""

    blinks: int
    what: str
    fix: str


NO_PROVISIONING = Fault(
    2,
    "the card has not been told which payload it is",
    "Put blimp.toml and the folder certificates into this folder (the ground station's `make flash`"
    " does so), and start the payload again.",
)
REFUSED = Fault(
    3,
    "something in this folder is refused; what was in force before still is",
    "Mend what the reason names, here on the boot partition, and start the payload again.",
)
NO_VIDEO = Fault(
    4,
    "the firmware sends no video",
    "Look at the camera's cable first. Settings of your own are in payload.toml in this folder:"
    " without that file the board's own are used.",
)
NO_NETWORK = Fault(
    5,
    "no network",
    "Check name, password, security and country of [wifi] in blimp.toml, and that the network is in"
    " reach: 2.4 GHz, as the Zero has no other. A new password is written there as it is; the card"
    " takes it out again.",
)
NO_DATA = Fault(
    6,
    "the data partition is broken or full",
    "Save what you need of it (it is the card's third partition, ext4), then write the card again."
    " A card that this happens to again is worn: take another one.",
)
ALL = (NO_PROVISIONING, REFUSED, NO_VIDEO, NO_NETWORK, NO_DATA)
