"""Labelled markers: placement on a body, subject, poses."""
