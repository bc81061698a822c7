"""Labels that changed places."""
