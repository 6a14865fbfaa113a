"""Text that comes from elsewhere, as it may be shown: it neither steers a terminal nor wraps."""


def printable(text: str, most: int | None = None, instead: str = "?") -> str:
    """One line of at most `most` characters, each that cannot be printed shown as `instead`.

    So are line ends, escapes, and what turns the direction of writing.
    """
    return "".join(c if c.isprintable() else instead for c in text[:most])


def shown(value: object, most: int = 60) -> str:
    """A value as one short line of at most `most` characters, as Python writes it."""
    if isinstance(value, int) and value.bit_length() > 128:  # Python refuses to print huge ones
        return f"a number of {value.bit_length()} bits"
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # such a number inside a list, or tables without end
        text = f"a {type(value).__name__}"
    return text if len(text) <= most else text[: most - 3] + "..."
