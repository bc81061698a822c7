"""Geometry in space: twists, lines, cameras; independent of bodies."""

from kinefit._doors import door_of

__getattr__, __dir__ = door_of(__name__)
