"""Calibration with a bar: two targets at a known distance, waved through the volume."""
