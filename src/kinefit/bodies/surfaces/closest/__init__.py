"""Closest points of surfaces."""
