"""From a checkout to a flying card: the image, the flasher, provisioning, updates.

Programs run from a checkout (`python -m deploy.image …`) with the standard library and Debian's
own tools. The firmware and the ground station are taken as files or run as programs, never
imported. What runs on the card lies in `deploy/board`.
"""
