"""Figures of kinefit, each printed by a command; peers run side by side. Nothing here may import kinefit at once."""
