"""The payload's program in flight, for the tests that need it whole."""

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from flying import Flying


@pytest.fixture
def flying(tmp_path: Path) -> Iterator[Flying]:
    """Not started yet; whatever a test leaves running is ended."""
    with ExitStack() as stack:
        yield Flying(stack, tmp_path)
