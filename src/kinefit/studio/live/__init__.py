"""Live sessions: sources of frames, a tracker, and receivers of its poses."""
