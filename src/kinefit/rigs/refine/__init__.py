"""Cameras refined with a body's own motion."""
