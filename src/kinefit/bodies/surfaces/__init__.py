"""Surfaces of a body's segments: tapered elliptical cylinders, meshes and metaballs."""

from kinefit.bodies.surfaces.anchors import SurfaceAnchors
from kinefit.bodies.surfaces.closest.nearest import Nearest, SurfaceTables, nearest
from kinefit.bodies.surfaces.cylinder import Box, TaperedCylinder, bounding_box
from kinefit.bodies.surfaces.fourier import FourierCurve, FourierSurface
from kinefit.bodies.surfaces.mesh import MeshSurface
from kinefit.bodies.surfaces.metaballs import Metaballs
from kinefit.bodies.surfaces.skins.skinning import SkinnedMesh
from kinefit.bodies.surfaces.triangles import BodyMesh, body_mesh, sample, segment_middles, triangles

Surface = TaperedCylinder | MeshSurface

__all__ = [
    "BodyMesh", "Box", "FourierCurve", "FourierSurface", "MeshSurface", "Metaballs", "Nearest", "SkinnedMesh",
    "Surface", "SurfaceAnchors", "SurfaceTables", "TaperedCylinder", "body_mesh", "bounding_box", "nearest",
    "sample", "segment_middles", "triangles",
]
