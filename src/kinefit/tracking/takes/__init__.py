"""Tracking of a take file: its recording, and its floor."""
