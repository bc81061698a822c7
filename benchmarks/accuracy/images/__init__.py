"""Silhouettes and colours of real and rendered images."""
