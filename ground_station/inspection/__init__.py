"""What a map holds, and how good it is."""
