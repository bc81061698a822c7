"""People with gear that closes chains."""
