"""Files to observations."""
