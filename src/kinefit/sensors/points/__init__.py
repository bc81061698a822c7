"""Sensors of points in images and in space: keypoints, markers, lines."""
