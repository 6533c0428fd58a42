"""Which layers' motion cues tell what moves is a property of a checkpoint: measure it, choose a table, store it."""
