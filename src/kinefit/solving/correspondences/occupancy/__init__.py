"""Rows of occupied and free space: depth images, free space, collisions."""
