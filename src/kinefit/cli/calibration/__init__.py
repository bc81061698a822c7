"""`kinefit calibrate`."""
