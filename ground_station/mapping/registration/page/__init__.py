"""The page that picks are made on: a map's top view beside the floor plan."""
