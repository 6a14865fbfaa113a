"""What a calibration can be refused for."""

from ground_station.errors import GroundStationError


class CalibrationError(GroundStationError):
    """Views that do not determine the camera, or a board that cannot be; one line names why."""
