"""`python -m deploy.image`."""

import sys

from deploy.image.command import main

sys.exit(main())
