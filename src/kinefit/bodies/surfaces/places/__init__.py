"""The surfaces of a body together: nearest points, anchors, one mesh, samples."""

from kinefit.bodies.surfaces.places.anchors import Nearest, SurfaceAnchors, body_mesh, nearest, nearest_lines, sample

__all__ = ["Nearest", "SurfaceAnchors", "body_mesh", "nearest", "nearest_lines", "sample"]
