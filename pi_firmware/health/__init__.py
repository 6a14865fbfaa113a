"""What the payload knows of itself: board, radio, tasks and restarts."""
