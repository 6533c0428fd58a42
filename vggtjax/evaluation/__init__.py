"""Metrics, what a blind guess scores in them, and the ladder of methods: pure functions on host arrays."""
