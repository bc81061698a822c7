"""P5: markers without labels (SAPM)."""
