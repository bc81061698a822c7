"""Bundle adjustment: bodies, cameras and shape of many frames in one bordered system."""
