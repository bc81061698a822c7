"""Simulated scenes and recordings that several folders share."""
