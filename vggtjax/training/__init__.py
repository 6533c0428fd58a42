"""Training on generated scenes: recipe -> batches -> objective -> optimiser -> checkpoints, metrics, a model."""
