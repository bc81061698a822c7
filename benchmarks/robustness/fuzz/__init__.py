"""Every reader on damaged files."""
