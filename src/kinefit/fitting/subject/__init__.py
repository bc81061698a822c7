"""Fit the size and shape of a person."""
