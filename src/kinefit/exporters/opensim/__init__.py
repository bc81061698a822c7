"""OpenSim files."""
