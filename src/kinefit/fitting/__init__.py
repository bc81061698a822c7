"""Fit a body to measurements: one frame, starts, the person, several views and people, tracking, whole takes."""
