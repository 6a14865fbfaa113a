"""`python -m hw`."""

import sys

from hw.command import main

sys.exit(main())
