"""Tracking of a take file: its recording, the people in view."""
