"""Programs that run for long: the live session, replay and demo."""
