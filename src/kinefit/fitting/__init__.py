"""Fit a body to measurements: one frame, starts, the person, several views and people, tracking, whole takes."""

from kinefit._doors import door_of

__getattr__, __dir__ = door_of(__name__)
