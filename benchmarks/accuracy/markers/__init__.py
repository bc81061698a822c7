"""Labelled and unlabelled markers."""
