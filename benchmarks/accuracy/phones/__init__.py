"""Telephones of which nothing is known."""
