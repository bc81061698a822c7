"""Gait and movements, against force plates and the files of laboratories."""
