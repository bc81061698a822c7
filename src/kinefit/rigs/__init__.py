"""Calibration of cameras: with boards, bars or people, refined with the body; and checks of a calibration."""

from kinefit._doors import door_of

__getattr__, __dir__ = door_of(__name__)
