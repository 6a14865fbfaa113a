"""What may happen to frames and maps, a file each, found by its `DISTURBANCE`."""
