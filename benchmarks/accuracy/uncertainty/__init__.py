"""Error bars against truth."""
