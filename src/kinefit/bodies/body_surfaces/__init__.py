"""The surfaces of a body together: nearest points, anchors, one mesh, samples."""

from kinefit.bodies.body_surfaces.anchors import SurfaceAnchors
from kinefit.bodies.body_surfaces.meshes import body_mesh, sample
from kinefit.bodies.body_surfaces.nearest import Nearest, nearest, nearest_lines

__all__ = ["Nearest", "SurfaceAnchors", "body_mesh", "nearest", "nearest_lines", "sample"]
