"""What the card is made of: Debian's packages, a kernel and the firmware's wheels, each verified.

Everything comes through a signature (apt) or a hash (`requirements.lock`), is kept in a cache that
is keyed by its inputs, and appears there whole or not at all. What is cached needs no network.
"""
