"""A source a file, found by its name: the scheme of `camera.uri`. `SOURCE` opens it."""
