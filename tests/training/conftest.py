"""Files of weights as the tests of bringing them in make them."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "feature_models"))  # for torch_files
