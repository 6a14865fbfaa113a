"""The ground station's exception family, a branch of the one that both sides share."""

from argparse import Namespace

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


class MapInUseError(MapError):
    """A map that another program is writing: it is free when that has ended."""


class KeysError(GroundStationError):
    """An authority, certificate or key that cannot be made, read or used."""


def check_options(args: Namespace, **allowed: tuple[float, float]) -> None:
    """Refuses a command's numbers, or lists of them, out of range; None is what was not given."""
    for name, (low, high) in allowed.items():
        said = getattr(args, name)
        for value in said if isinstance(said, list) else [said]:
            if value is not None and not low <= value <= high:
                option = name.replace("_", "-")
                raise InputError(f"--{option} is {value}; allowed: {low} to {high}")
