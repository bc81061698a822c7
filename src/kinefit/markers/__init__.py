"""Unlabelled markers: who is who (P5)."""

from kinefit._doors import door_of

__getattr__, __dir__ = door_of(__name__)
