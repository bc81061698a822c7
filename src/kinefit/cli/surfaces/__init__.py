"""`kinefit surface`."""
