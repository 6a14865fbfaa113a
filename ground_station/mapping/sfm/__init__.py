"""The border to COLMAP: structure from motion, and its models on disk."""
