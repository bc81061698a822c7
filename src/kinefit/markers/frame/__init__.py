"""Label the markers of one frame."""
