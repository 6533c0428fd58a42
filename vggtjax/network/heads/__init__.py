"""Tokens -> cameras, dense maps, tracks."""
