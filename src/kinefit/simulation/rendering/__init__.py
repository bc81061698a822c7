"""Render the images that sensors would record of a known motion."""
