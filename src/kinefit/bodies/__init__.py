"""Bodies: kinematic trees with named points and surfaces."""

from kinefit.bodies.body import Body, PointSet
from kinefit.bodies.marker_sets import placement
from kinefit.bodies.morphs.morphing import Morphing
from kinefit.bodies.serial import load_body, save_body
from kinefit.bodies.surfaces import MeshSurface, TaperedCylinder
from kinefit.bodies.toml.bodies import catalogue, parse_body
from kinefit.bodies.tree import BodyState, KinematicTree

__all__ = [
    "Body", "BodyState", "KinematicTree", "MeshSurface", "Morphing", "PointSet", "TaperedCylinder", "catalogue",
    "load_body", "parse_body", "placement", "save_body",
]
