"""Stopped by a person, with what that means for the card."""

from deploy.errors import DeployError


class Interrupted(DeployError):
    """Ctrl-C, a kill or a closed terminal while the card was being written."""
