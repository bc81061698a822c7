"""Sensors of regions of an image: colours of segments, silhouettes."""
