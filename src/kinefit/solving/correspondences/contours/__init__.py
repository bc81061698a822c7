"""Rows of contours: the occluding contour of a body against silhouettes in images."""
