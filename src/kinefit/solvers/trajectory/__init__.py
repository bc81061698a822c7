"""Smoothing of a whole trajectory: a banded system over the frames."""
