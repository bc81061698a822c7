"""Keypoints of calibrated videos, and the calibration."""
