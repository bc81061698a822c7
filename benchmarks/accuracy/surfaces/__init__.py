"""Image matching and surfaces."""
