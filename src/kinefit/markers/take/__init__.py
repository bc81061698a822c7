"""Label the markers of a whole take."""
