"""The ground station: receives the payload's video, maps the building, finds the camera in it."""

__version__ = "0.1.0"
