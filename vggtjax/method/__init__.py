"""The papers' method: motion cues, dynamic mask, the two passes, refinement and fusion (VGGT4D, 4DVGGT-D)."""
