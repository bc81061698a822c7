"""Bright points, and points of one camera."""
