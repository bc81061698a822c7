"""Sensors of surfaces: depth images, point clouds, tracked surface points."""
