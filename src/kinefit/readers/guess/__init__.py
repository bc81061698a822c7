"""A first take file from a folder."""
