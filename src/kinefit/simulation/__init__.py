"""A known motion, and what sensors would have seen of it."""
