"""Smooth while tracking: a window of frames behind the newest one."""
