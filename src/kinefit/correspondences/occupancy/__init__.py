"""Rows of what is full and what is empty: depth images, free space, bodies that collide."""
