"""Skins: meshes blended between segments; made from tubes, subdivided, read from files."""
