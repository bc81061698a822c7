"""The sources themselves, counted."""
