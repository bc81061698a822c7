"""A whole take: what it lacks is found, who is in view, and their motions."""
