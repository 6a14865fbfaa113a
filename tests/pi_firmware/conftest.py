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
        made = Flying(stack, tmp_path)
        yield made
        if made.process is not None and made.process.poll() is None:
            made.process.kill()
            made.process.wait()
