"""Live sessions: sources that bring frames as they are seen, a tracker, and receivers of its poses."""
