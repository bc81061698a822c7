"""What many tests need: random bodies and states, and a slow forward kinematics to compare with."""

import numpy as np
from scipy.linalg import expm

from kinefit.bodies import Body, BodyState, KinematicTree, PointSet
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, Rig
from kinefit.solving.rows import DofRows, PairRows, ParameterRows

STATES = ("random", "identity", "near identity", "near pi")


def random_unit(random, *shape):
    v = random.normal(size=(*shape, 3))
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def random_body(seed=0, segments=9, *, root_free=True, prismatic=0.3):
    """A body that branches at random, with zero to three coordinates a joint, revolute and prismatic, and three points
    on every segment."""
    random = np.random.default_rng(seed)
    parents = np.array([-1] + [int(random.integers(0, s)) for s in range(1, segments)])
    counts = random.integers(0, 4, segments)
    counts[0] = 0 if root_free else 1
    owners = np.repeat(np.arange(segments), counts)
    dofs = len(owners)
    tree = KinematicTree(
        segments=tuple(f"s{i}" for i in range(segments)),
        parents=parents,
        offsets=np.where(np.arange(segments)[:, None] > 0, random.normal(scale=0.3, size=(segments, 3)), 0.0),
        coordinates=tuple(f"q{i}" for i in range(dofs)),
        owners=owners,
        axes=random_unit(random, dofs),
        prismatic=random.random(dofs) < prismatic,
        lower=np.full(dofs, -4.0),
        upper=np.full(dofs, 4.0),
        usual=np.zeros(dofs),
        spread=np.full(dofs, 1.0),
        root_free=root_free,
    )
    points = PointSet(
        tuple(f"p{i}" for i in range(3 * segments)),
        np.repeat(np.arange(segments), 3),
        random.normal(scale=0.2, size=(3 * segments, 3)),
    )
    names = tuple(f"joint{i}" for i in range(segments))
    return Body("random", tree, names, tree.segments, np.arange(segments), points, stature=1.0)


def state_of(body, kind, seed=0):
    """A state at which derivatives are checked: random, identity, near identity (1e-7) or near π."""
    random = np.random.default_rng(seed)
    dofs = len(body.tree.coordinates)
    if kind == "random":
        return BodyState(se3.exp(random.normal(size=6)), random.uniform(-1.5, 1.5, dofs))
    if kind == "identity":
        return BodyState(np.eye(4), np.zeros(dofs))
    if kind == "near identity":
        return BodyState(se3.exp(1e-7 * random.normal(size=6)), 1e-7 * random.normal(size=dofs))
    turn = np.concatenate([random.normal(size=3), (np.pi - 1e-7) * random_unit(random)])
    return BodyState(se3.exp(turn), np.where(body.tree.prismatic, 0.3, np.pi - 1e-7) * random.choice([-1, 1], dofs))


def posture(body, seed=0, share=0.5):
    """A state like those that people take: near the usual one, anywhere, any heading, little tilt (y up)."""
    random = np.random.default_rng(seed)
    tree = body.tree
    spread = np.minimum(tree.spread, 1.5)
    angles = np.clip(tree.usual + share * spread * random.normal(size=len(spread)), 0.9 * tree.lower, 0.9 * tree.upper)
    turn = se3.exp_so3([0, random.uniform(-np.pi, np.pi), 0]) @ se3.exp_so3(0.25 * random.normal(size=3))
    return BodyState(se3.transform(turn, random.normal(scale=(1.0, 0.2, 1.0))), angles)


def slow_motions(tree, state):
    """(S, 4, 4): what moves points from the root frame at rest to the world: matrix exponentials, one by one."""
    rest = np.zeros((len(tree.segments), 3))
    for s, parent in enumerate(tree.parents):
        rest[s] = rest[parent] + tree.offsets[s] if parent >= 0 else 0.0
    twists = np.zeros((len(tree.coordinates), 4, 4))
    for d, (x, y, z) in enumerate(tree.axes):
        if tree.prismatic[d]:
            twists[d, :3, 3] = (x, y, z)
        else:
            twists[d, :3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
            twists[d, :3, 3] = -twists[d, :3, :3] @ rest[tree.owners[d]]
    moves = expm(twists * state.angles[:, None, None])
    out = []
    for s, parent in enumerate(tree.parents):
        T = np.array(state.T_world_root) if parent < 0 else out[parent].copy()
        for d in np.flatnonzero(tree.owners == s):
            T = T @ moves[d]
        out.append(T)
    return np.array(out)


def slow_positions(body, state, points):
    """(K, 3) [m] points in the world."""
    T = slow_motions(body.tree, state)[points.segments]
    return (T[:, :3, :3] @ body.points_rest(points)[..., None])[..., 0] + T[:, :3, 3]


def central_differences(function, body, state, step=1e-6):
    """∂ function(state) / ∂ δ, (..., 6 + D)."""
    columns = []
    for delta in step * np.eye(body.tree.n_dofs):
        columns.append((function(state.retract(delta)) - function(state.retract(-delta))) / (2 * step))
    return np.stack(columns, axis=-1)


def design(rows, body, state):
    """(N, 6 + D) a J of each row: how fast its point moves along its direction."""
    if isinstance(rows, DofRows):
        return rows.jacobian
    if isinstance(rows, ParameterRows):
        return np.eye(body.tree.n_dofs)[rows.index]
    if isinstance(rows, PairRows):
        a = speed(body, state, rows.segments[:, 0], rows.point_a, rows.direction)
        return a - speed(body, state, rows.segments[:, 1], rows.point_b, rows.direction)
    return speed(body, state, rows.segment, rows.point, rows.direction)


def speed(body, state, segment, point, direction):
    _, screws = body.tree.forward(state.T_world_root, state.angles)
    a = np.c_[direction, np.cross(point - state.T_world_root[:3, 3], direction)]
    return np.stack([a[i] @ body.tree.segment_jacobian(screws, s) for i, s in enumerate(segment)])


def look_at(name, place, aim, *, distortion=(-0.1, 0.05, 0.001, -0.002), focal=900.0, model="radtan"):
    """A camera of 1280 x 960 pixels at a place [m] that looks at another."""
    place, aim = np.asarray(place, float), np.asarray(aim, float)
    z = (aim - place) / np.linalg.norm(aim - place)
    x = np.cross(z, (0.0, 1.0, 0.0) if abs(z[1]) < 0.9 else (1.0, 0.0, 0.0))
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    matrix = [[focal, 0, 639.5], [0, focal, 479.5], [0, 0, 1]]
    return Camera(name, (1280, 960), matrix, distortion, model, se3.transform(R, -R @ place))


def rig_around(aim, *, cameras=4, distance=4.0, height=0.4):
    """Cameras on a circle around a point [m], y up."""
    azimuths = 2 * np.pi * (np.arange(cameras) + 0.3) / cameras + 0.2 * (np.arange(cameras) % 2)
    places = [
        np.asarray(aim) + (distance * np.cos(a), height * (i % 3), distance * np.sin(a)) for i, a in enumerate(azimuths)
    ]
    return Rig(tuple(look_at(f"cam{i + 1}", place, aim) for i, place in enumerate(places)))
