"""What can go wrong in training."""

from ground_station.errors import GroundStationError


class TrainingError(GroundStationError):
    """A setting, file or machine with which the recipe cannot run."""
