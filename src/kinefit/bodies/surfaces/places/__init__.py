"""The surfaces of a body together: nearest points, anchors, one mesh, samples."""

from kinefit.bodies.surfaces.places.anchors import Nearest, SurfaceAnchors, nearest, nearest_lines
from kinefit.bodies.surfaces.places.meshes import body_mesh, sample

__all__ = ["Nearest", "SurfaceAnchors", "body_mesh", "nearest", "nearest_lines", "sample"]
