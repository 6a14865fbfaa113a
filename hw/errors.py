"""The errors of this room, a branch of the family that all programs share."""

from pi_firmware.wire.errors import BlimpError


class HardwareError(BlimpError):
    """A part, build or physical input that cannot be; one line that names value and limit."""
