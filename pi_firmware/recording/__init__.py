"""Recordings on the payload's own card: bounded in size, whole up to a power cut.

`recorder` is the door, `flight` what is in a file and when the next begins. How files get to the
disk is shared with the ground station: `pi_firmware.wire.recorder`.
"""

from pi_firmware.recording.recorder import Recorder

__all__ = ["Recorder"]
