"""What each kind of sensor saw of a body, ready to make rows."""
