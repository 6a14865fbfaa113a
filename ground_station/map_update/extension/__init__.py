"""A map that grows: flights under another light, or of another wing, join it."""
