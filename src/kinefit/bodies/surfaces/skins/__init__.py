"""Skins: meshes blended between segments, made from tubes, subdivided, in files."""
