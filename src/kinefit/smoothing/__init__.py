"""A whole take at once: smoother, process noise, gaps, contacts, uncertainty."""
