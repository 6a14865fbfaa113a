"""Recordings on the payload's own card: bounded in size, whole up to a power cut.

`recorder` is the door, `run` one recording on its own thread, `intake` what waits for the disk,
`file` one MCAP file and `folder` the numbered files of all flights.
"""

from pi_firmware.recording.recorder import Recorder

__all__ = ["Recorder"]
