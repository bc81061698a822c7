"""Smooth a whole take: motion prior, process noise, gaps, foot contacts, uncertainty."""
