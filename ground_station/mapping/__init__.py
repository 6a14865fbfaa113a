"""From frames to a registered map."""
