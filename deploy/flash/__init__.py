"""Writes a card and tells it its world; refuses rather than guesses, and reads back."""
