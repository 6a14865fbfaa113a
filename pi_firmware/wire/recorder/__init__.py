"""How both sides record: bounded in size, whole up to a power cut, and nobody waits for the disk.

`recorder` is the door, `run` one recording on its own thread, with what waits for the disk, `file`
one MCAP file, and `folder` the numbered files of all flights. What goes into a file, and when the
next begins, is for the side that records to say.
"""
