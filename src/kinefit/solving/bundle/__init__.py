"""Bundle adjustment: poses of many frames, body shape and cameras in one bordered system."""
