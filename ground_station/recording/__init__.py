"""Frames from recordings, video files and image folders, and recordings of flights."""
