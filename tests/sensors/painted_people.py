"""A person in painted parts before a patterned wall, for tests of regions."""

from functools import cache

import numpy as np

from kinefit.bodies import BodyState, load_body
from kinefit.bodies.rendering import render_body
from kinefit.bodies.surfaces.places import body_mesh
from kinefit.geometry.camera import Camera, Rig
from kinefit.observations import ColourFrame

BODY = load_body("humanoid")
SKIN, SHIRT, TROUSERS = (200, 150, 130), (40, 80, 160), (60, 50, 40)
PAINT = {
    **dict.fromkeys(("head", "hand", "forearm", "foot", "toes"), SKIN),
    **dict.fromkeys(("upperarm", "clavicle", "thorax", "abdomen"), SHIRT),
    **dict.fromkeys(("pelvis", "thigh", "shank"), TROUSERS),
}
WALL = (90, 130, 90), (130, 120, 110)


def _camera(name, turn):
    """In front of the person, 2.4 m away, turned about the vertical; y up in the world."""
    z = np.array([-np.cos(turn), 0.0, -np.sin(turn)])
    R = np.stack([np.cross(z, (0.0, 1.0, 0.0)), (0.0, -1.0, 0.0), z])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, -R @ (np.array([0.0, 0.85, 0.0]) - 2.4 * z)
    return Camera(name, (220, 260), [[260.0, 0, 109.5], [0, 260.0, 129.5], [0, 0, 1]], T_camera_world=T)


RIG = Rig((_camera("front", 0.0), _camera("side", 1.3)))


def person(*, at=(0.0, 0.0, 0.0), **degrees):
    """Standing, at its usual posture but for some angles [deg]."""
    T = np.eye(4)
    T[:3, 3] = np.array([0.0, 0.92, 0.0]) + at
    state = BODY.default_state(T)
    angles = state.angles.copy()
    for name, value in degrees.items():
        angles[BODY.tree.coordinate(name)] = np.radians(value)
    return BodyState(T, angles)


@cache
def _mesh():
    return body_mesh(BODY)


def image(state, camera, *, seed=0, light=1.0, paint=None, people=(), wall=WALL):
    """(260, 220, 3) uint8 of a person, and of others in one colour each before it: (state, colour)."""
    random, (width, height) = np.random.default_rng(seed), camera.size
    squares = (np.add.outer(np.arange(height) // 17, np.arange(width) // 23) % 2)[..., None]
    out = np.where(squares == 0, *wall).astype(float)
    colours = {**PAINT, **(paint or {})}
    drawn = render_body(BODY, state, camera, mesh=_mesh())
    of = np.array([colours[name.removesuffix("_r").removesuffix("_l")] for name in BODY.tree.segments], float)
    out[drawn.seen] = of[drawn.segment[drawn.seen]]
    for other, colour in people:
        out[render_body(BODY, other, camera, mesh=_mesh()).seen] = colour
    return np.clip(light * out + random.normal(0, 5, out.shape), 0, 255).astype(np.uint8)


def frames(state, time=0.0, rig=RIG, **options):
    """What the cameras see."""
    return [ColourFrame(c.name, time, image(state, c, **options)) for c in rig]
