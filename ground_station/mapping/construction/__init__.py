"""From frames to a map."""
