"""Matching of image patches: correlation, least squares in many images, noise."""
