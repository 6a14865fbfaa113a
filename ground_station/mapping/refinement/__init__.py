"""A map that flights made better."""
