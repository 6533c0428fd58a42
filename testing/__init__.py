"""What tests and benchmarks share: seeded weights, numbers of the public code, checkpoints to convert."""
