"""Smooth a whole trajectory: a banded system over the frames."""
