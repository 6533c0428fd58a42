"""What is measured and fitted: evaluation, calibration, learning, parity with public code."""
