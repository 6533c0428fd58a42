"""Files: atomic writes, the user's cache, tensors, arrays, trajectories, compiled programs."""
