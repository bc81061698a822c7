"""Surfaces from images: least-squares matching, region growing, forward intersection, strain, tracking."""
