"""Cameras calibrated with a board."""
