"""Unlabelled markers: who is who (P5)."""
