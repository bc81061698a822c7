"""Cameras calibrated from the people in view."""
