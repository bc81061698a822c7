"""Surfaces of a body's segments: tapered elliptical cylinders, meshes and metaballs."""

from kinefit.bodies.surfaces.cylinder import Box, TaperedCylinder, bounding_box
from kinefit.bodies.surfaces.fourier import FourierCurve, FourierSurface
from kinefit.bodies.surfaces.mesh import BodyMesh, MeshSurface, segment_middles, triangles
from kinefit.bodies.surfaces.metaballs import Metaballs
from kinefit.bodies.surfaces.skins.skinning import SkinnedMesh
from kinefit.bodies.surfaces.tables import SurfaceTables

Surface = TaperedCylinder | MeshSurface

__all__ = [
    "BodyMesh", "Box", "FourierCurve", "FourierSurface", "MeshSurface", "Metaballs", "SkinnedMesh", "Surface",
    "SurfaceTables", "TaperedCylinder", "bounding_box", "segment_middles", "triangles",
]
