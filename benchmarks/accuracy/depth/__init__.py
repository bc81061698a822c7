"""Depth images, surfaces and renderings."""
