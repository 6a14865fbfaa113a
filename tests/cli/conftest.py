"""What other rooms' tests make, for the pages that take it for granted."""

import sys
from pathlib import Path

for room in ("calibration", "deploy/flash", "replay", "simulator"):
    sys.path.append(str(Path(__file__).parents[1] / room))
