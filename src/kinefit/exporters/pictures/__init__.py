"""Overlays and pictures."""
