"""Networks and models of the tests of features are brought in here."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "features"))  # for made_up, reference
