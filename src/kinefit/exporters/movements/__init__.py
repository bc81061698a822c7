"""Jumps, squats and sit to stand: counted and timed, one file a movement."""
