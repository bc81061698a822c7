"""`kinefit markers`."""
