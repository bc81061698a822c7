"""Rows of contours in images: outlines of a body against edges."""
