"""The localizer process: a payload's newest frame in, its pose out, every frame accounted for."""
