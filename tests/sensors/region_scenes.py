"""A rigid thing of two blocks, painted before a patterned wall, for tests of regions."""

from functools import cache

import numpy as np

from kinefit.bodies import Body, BodyState, PointSet
from kinefit.bodies.rendering import render_body
from kinefit.bodies.surfaces import MeshSurface
from kinefit.bodies.tree import KinematicTree
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, Rig
from kinefit.observations import ColourFrame

CAMERA = Camera("cam", (240, 200), [[300.0, 0, 119.5], [0, 300.0, 99.5], [0, 0, 1]])
RIG = Rig((CAMERA,))
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
_FACES = np.array([
    (0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1), (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4),
    (1, 5, 7), (1, 7, 3),
])  # fmt: skip


@cache
def thing():
    """A body of one segment that moves freely, 16 cm long."""
    parts = [((0.0, 0.0, 0.0), (0.08, 0.02, 0.03)), ((0.05, 0.05, 0.01), (0.02, 0.04, 0.02))]
    x = np.concatenate([_CORNERS * half + at for at, half in parts])
    faces = np.concatenate([_FACES, _FACES + 8])
    none = np.zeros(0)
    tree = KinematicTree(
        ("thing",), np.array([-1]), np.zeros((1, 3)), (), none, np.zeros((0, 3)), none, none, none, none, none
    )
    point = PointSet(("middle",), np.zeros(1, int), np.zeros((1, 3)))
    surface = MeshSurface(0, x, faces)
    return Body("thing", tree, ("free",), ("whole",), np.zeros(1, int), point, surfaces=(surface,))


def state(shift=(0.0, 0.0, 0.0), turn=(0.0, 0.0, 0.0)):
    """Half a metre before the camera."""
    T = np.eye(4)
    T[:3, :3] = se3.exp_so3(np.array([0.3, -0.4, 0.2])) @ se3.exp_so3(np.array(turn))
    T[:3, 3] = np.array([0.0, 0.0, 0.5]) + shift
    return BodyState(T, np.zeros(0))


def image(truth, *, body=(190, 60, 50), wall=((90, 120, 90), (120, 110, 150)), seed=0, light=1.0):
    """(200, 240, 3) uint8: the thing in one colour before a wall of two, with noise."""
    random = np.random.default_rng(seed)
    squares = (np.add.outer(np.arange(200) // 17, np.arange(240) // 23) % 2)[..., None]
    out = np.where(squares == 0, wall[0], wall[1]).astype(float)
    out[render_body(thing(), truth, CAMERA).seen] = body
    return np.clip(light * out + random.normal(0, 6, out.shape), 0, 255).astype(np.uint8)


def frame(truth, time=0.0, **options):
    """What the camera sees."""
    return ColourFrame("cam", time, image(truth, **options))


def off(found, truth):
    """How far a state is from another [m], [deg]."""
    A, B = found.T_world_root, truth.T_world_root
    turn = np.linalg.norm(se3.log_so3(A[:3, :3].T @ B[:3, :3]))
    return float(np.linalg.norm(A[:3, 3] - B[:3, 3])), float(np.degrees(turn))
