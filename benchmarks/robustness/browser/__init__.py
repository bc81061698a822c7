"""The window and the live server under clicks, kills and attacks."""
