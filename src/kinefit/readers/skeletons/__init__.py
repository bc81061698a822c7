"""Recorded skeletons."""
