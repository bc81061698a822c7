"""Geometry in space: twists, lines, cameras; independent of bodies."""
