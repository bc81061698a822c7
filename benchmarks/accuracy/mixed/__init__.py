"""Several sensors together, by take files."""
