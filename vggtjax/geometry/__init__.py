"""Geometry of space that is not of one camera."""
