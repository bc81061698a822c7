"""The surfaces of a body together: nearest points, anchors, one mesh, samples."""

from kinefit.bodies.surfaces.places.anchors import SurfaceAnchors
from kinefit.bodies.surfaces.places.meshes import body_mesh, sample
from kinefit.bodies.surfaces.places.nearest import Nearest, nearest, nearest_lines

__all__ = ["Nearest", "SurfaceAnchors", "body_mesh", "nearest", "nearest_lines", "sample"]
