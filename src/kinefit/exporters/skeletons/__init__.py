"""Animated skeletons and figures."""
