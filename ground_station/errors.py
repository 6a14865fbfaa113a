"""The ground station's exception family, a branch of the one that both sides share."""

from pi_firmware.wire.errors import BlimpError


class GroundStationError(BlimpError):
    """Base of the ground station's errors; the text is one line that names value and limit."""


class GeometryError(GroundStationError):
    """Degenerate or non-finite geometry."""


class CameraError(GroundStationError):
    """A camera file that is missing, incomplete or not finite."""


class InputError(GroundStationError):
    """A folder, video file or recording that gives no frames."""


class MapError(GroundStationError):
    """A map that cannot be built, read or used with this localizer."""


class KeysError(GroundStationError):
    """An authority, certificate or key that cannot be made, read or used."""
