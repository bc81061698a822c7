"""`kinefit check`."""
