"""Depth recordings."""
