"""Space: twists, lines, cameras; knows no body."""
