"""Choice of motion cues for a checkpoint: measure the maps of every pair, choose a table, store it in the model."""
