"""Solve for states from rows: normal equations, least squares, constraints, sequences, assignment."""

from kinefit._doors import door_of

__getattr__, __dir__ = door_of(__name__)
