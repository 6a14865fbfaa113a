"""Camera model, poses, trajectories, alignment: pure functions on arrays."""
