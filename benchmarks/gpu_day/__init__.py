"""What the first hour on an accelerator should tell: python -m benchmarks gpu-day."""
