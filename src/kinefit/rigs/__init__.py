"""Calibration of cameras: with boards, bars or people, refined with the body; and checks of a calibration."""
