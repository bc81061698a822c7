"""P3: regions of colour, bodies with gear."""
