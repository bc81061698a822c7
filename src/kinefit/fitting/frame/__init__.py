"""Fit one frame: route sensor data to measurements, fit the pose, and assess the result."""
