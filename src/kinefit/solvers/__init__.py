"""Rows to a state."""
