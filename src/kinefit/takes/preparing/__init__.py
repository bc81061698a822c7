"""What a take needs before it is tracked."""
