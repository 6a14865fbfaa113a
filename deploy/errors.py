"""The one error that a person at `deploy`'s commands can cause."""


class DeployError(Exception):
    """One line that names the value and the limit; a command prints it and exits with 2."""
