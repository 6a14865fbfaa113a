"""The camera's calibration from views of a printed board: lens, and rolling shutter."""
