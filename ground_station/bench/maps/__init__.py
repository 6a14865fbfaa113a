"""What the size of a map costs in accuracy."""
