"""What each kind of sensor saw of a body, ready to make rows."""

from kinefit._doors import door_of

__getattr__, __dir__ = door_of(__name__)
