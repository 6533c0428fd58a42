"""What several tests, and benchmarks, use: seeded weights, golden numbers, small worlds."""
