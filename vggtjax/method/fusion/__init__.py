"""Depth of two passes as one: the paper's rule, rules with parameters, their file."""
