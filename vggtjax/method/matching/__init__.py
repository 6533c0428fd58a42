"""Motion from matches between frames, which is not in the papers."""
