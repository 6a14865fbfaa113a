"""Sends this checkout's firmware to a payload as a signed bundle; `deploy/board/releases` takes it.

A bundle is a tar (ustar): the list of files with their SHA-256, OpenSSH's signature of that list,
then the files, in the list's order. Those that the card has already are left out.
"""
