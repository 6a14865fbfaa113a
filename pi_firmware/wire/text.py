"""Text that comes from elsewhere, as it may be shown: it neither steers a terminal nor wraps."""


def printable(text: str, most: int | None = None, instead: str = "?") -> str:
    """One line of at most `most` characters, each that cannot be printed shown as `instead`.

    So are line ends, escapes, and what turns the direction of writing.
    """
    return "".join(c if c.isprintable() else instead for c in text[:most])
