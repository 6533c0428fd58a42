"""Models by path or name, and the embedded model with its clip."""
