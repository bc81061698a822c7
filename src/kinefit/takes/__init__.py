"""A whole take: what it lacks is found, who is in view, and their motions."""

from kinefit._doors import door_of

__getattr__, __dir__ = door_of(__name__)
