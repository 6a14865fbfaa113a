"""The ground station: receives the payload's video, maps the building, finds the camera in it."""

import os

from pi_firmware import __version__ as __version__

# OpenCV reads it when it is imported: no picture here has more pixels, and a small file of zeros
# could else ask for a gigabyte.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(1 << 27))
