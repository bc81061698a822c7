"""P2: boxes, depth and features (VooDoo)."""
