"""Readers of depth images and point clouds."""
