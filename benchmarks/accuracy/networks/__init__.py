"""Benchmarks of networks of a user's own."""
