"""`python -m deploy.flash`."""

import sys

from deploy.flash.command import main

sys.exit(main())
