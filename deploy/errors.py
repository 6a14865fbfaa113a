"""The one error that a person at `deploy`'s commands can cause, and how its text may look."""


def printable(text: str) -> str:
    """One line; what cannot be printed, line ends and escapes among it, is shown as `?`.

    A disk's name, a network's or what another machine said comes from whoever made it.
    """
    return "".join(c if c.isprintable() else "?" for c in text)


class DeployError(Exception):
    """One line that names the value and the limit; a command prints it and exits with 2."""

    def __init__(self, text: str = "") -> None:
        super().__init__(printable(text))


class Interrupted(DeployError):
    """Ctrl-C, a kill or a closed terminal while a card was being written, and what it is now."""
