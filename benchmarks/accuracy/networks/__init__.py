"""The networks of the detector, and what other programs estimated."""
