"""The map itself: tables, folder, floor plan, its accuracy, and what flights saw of it."""
