"""Surfaces that change with angles and shape: operators, steering, files."""
