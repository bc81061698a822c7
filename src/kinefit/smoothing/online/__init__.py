"""Smoothing while tracking goes on: a window of frames behind the newest one."""
