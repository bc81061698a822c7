"""Images that sensors would have taken of a known motion."""
