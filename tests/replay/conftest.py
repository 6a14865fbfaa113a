"""Pages are read as the tests of evaluation read theirs."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "evaluation"))  # for parsed_page
