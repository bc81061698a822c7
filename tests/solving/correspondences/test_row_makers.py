"""Every row maker: its residuals against plain numpy and OpenCV, its derivatives against central differences."""

import importlib
import pkgutil
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
from tests.oracle import (
    STATES,
    central_differences,
    design,
    look_at,
    random_body,
    random_unit,
    slow_positions,
    state_of,
)

import kinefit.solving.correspondences as correspondences
from kinefit.bodies import BodyState, PointSet, TaperedCylinder, load_body
from kinefit.bodies.morphs.morphing import Morphing
from kinefit.bodies.morphs.operators import JointMotion, LocalMorph, Steering
from kinefit.bodies.surfaces import Metaballs, SkinnedMesh
from kinefit.bodies.tree import Closure
from kinefit.errors import KinefitError
from kinefit.geometry import lines
from kinefit.geometry.camera import Rig
from kinefit.solving.correspondences import (
    Bands,
    anchored_rows,
    band_rows,
    closure_rows,
    coincidence_rows,
    collision_rows,
    depth_image_rows,
    edge_rows,
    field_rows,
    free_space_rows,
    image_line_rows,
    limit_rows,
    morphed_outline_rows,
    morphed_rows,
    outline_rows,
    pixel_rows,
    plane_rows,
    point_rows,
    prediction_rows,
    prior_rows,
    ray_rows,
    surface_rows,
    target_rows,
)
from kinefit.solving.correspondences.contours.outlines import Rim
from kinefit.solving.correspondences.occupancy.free_space import CollisionPairs, FreeSpace, SurfaceSamples

LENSES = (("radtan", (-0.1, 0.05, 0.001, -0.002, 0.01)), ("radtan", ()), ("fisheye", (0.02, -0.01, 0.003, -0.001)))


class Scene:
    """A body at a state, what sensors saw of it, and cameras that see all of it."""

    def __init__(self, body, state, seed=0):
        random = np.random.default_rng(seed)
        self.body, self.state = body, state
        rows = random.permutation(len(body.landmarks))[:14]
        names = tuple(body.landmarks.names[i] for i in rows)
        self.points = body.landmarks.select(names)
        self.others = body.landmarks.select(names[::-1])
        self.x = slow_positions(body, state, self.points)
        count = len(rows)
        self.target = self.x + random.normal(scale=0.1, size=(count, 3))
        self.sigma = random.uniform(0.5, 2.0, count)
        self.normal = random_unit(random, count)
        self.line = lines.line_along(self.target, random_unit(random, count))
        self.line[0, :3] = (0.0, 0.0, -1.0)  # where a frame about a direction is hardest to find
        self.line[0, 3:] = np.cross(self.target[0], self.line[0, :3])
        centre = self.x.mean(axis=0)
        reach = 3.0 + 2.0 * np.linalg.norm(self.x - centre, axis=1).max()
        self.rig = Rig(
            tuple(
                look_at(f"cam{i}", centre + reach * random_unit(random), centre, model=model, distortion=distortion)
                for i, (model, distortion) in enumerate(LENSES)
            )
        )
        self.camera = np.arange(count) % len(LENSES)
        self.uv = self.pixels() + random.normal(scale=20, size=(count, 2))
        turn = random.uniform(0, 2 * np.pi, count)
        across = np.stack([np.cos(turn), np.sin(turn)], axis=1)
        self.image_line = np.c_[across, -np.sum(across * self.uv, axis=1)] * random.uniform(-3, 3, (count, 1))
        self.random = random

    def pixels(self, points=None):
        """(K, 2) [px] by OpenCV."""
        x = slow_positions(self.body, self.state, points or self.points)
        return np.array([self.seen(c, v)[0] for c, v in zip(self.camera, x, strict=True)])

    def seen(self, camera, x):
        """Pixel (2,) of a point by OpenCV, and ∂ pixel / ∂ point (2, 3)."""
        c = self.rig.cameras[camera]
        R, t = c.T_camera_world[:3, :3], c.T_camera_world[:3, 3]
        k = c.distortion if c.distortion.size else np.zeros(4)
        project = cv2.fisheye.projectPoints if c.model == "fisheye" else cv2.projectPoints
        uv, J = project(x[None, None], cv2.Rodrigues(R)[0], t, c.matrix, k)
        by_translation = J[:, 11:14] if c.model == "fisheye" else J[:, 3:6]
        return uv[0, 0], by_translation @ R


def closed_body(s):
    """The scene's body with a closure of each kind between segments, and with the world."""
    names, segments = list(s.body.landmarks.names), s.body.landmarks.segments
    a = names[0]
    b = next(n for n, segment in zip(names, segments) if segment != segments[0])
    turn = tuple(s.random.normal(size=3))
    kinds = [("point", ""), ("line", ""), ("plane", b), ("rigid", b), ("line", b), ("rigid", "")]
    closures = [
        Closure(f"c{k}", kind, a, to, place=(0.3, 0.1, -0.2), axis=tuple(random_unit(s.random)), turn=turn, sigma=0.01)
        for k, (kind, to) in enumerate(kinds)
    ]
    return replace(s.body, closures=tuple(closures))


# One entry for each public row maker: scene -> (state -> rows).
CASES = {
    "closure_rows": lambda s: partial(closure_rows, closed_body(s)),
    "point_rows": lambda s: lambda state: point_rows(s.body, state, s.points, s.target, sigma=s.sigma),
    "plane_rows": lambda s: lambda state: plane_rows(s.body, state, s.points, s.target, s.normal, sigma=s.sigma),
    "ray_rows": lambda s: lambda state: ray_rows(s.body, state, s.points, s.line, sigma=s.sigma),
    "pixel_rows": lambda s: lambda state: pixel_rows(s.body, state, s.points, s.rig, s.camera, s.uv, sigma=s.sigma),
    "image_line_rows": lambda s: (
        lambda state: image_line_rows(s.body, state, s.points, s.rig, s.camera, s.image_line, sigma=s.sigma)
    ),
    "edge_rows": lambda s: (
        lambda state: edge_rows(s.body, state, s.points, s.others, s.rig, s.camera, s.image_line, sigma=s.sigma)
    ),
    "band_rows": lambda s: (
        lambda state: band_rows(s.body, state, Bands(s.points, s.others, s.points.segments), sigma=s.sigma)
    ),
    "coincidence_rows": lambda s: lambda state: coincidence_rows(s.body, state, s.points, s.others, sigma=s.sigma),
    "collision_rows": lambda s: (
        lambda state: collision_rows(s.body, state, pairs=random_capsules(s), margin=9.0, sigma=0.7)
    ),
    "depth_image_rows": lambda s: (
        lambda state: depth_image_rows(frames(s, state), *measured_samples(s), reach=np.inf, facing=-1.0)
    ),
    "free_space_rows": lambda s: (
        lambda state: free_space_rows(frames(s, state), *seen_through(s), sigma=2.0, tolerance=0.0, reach=np.inf)
    ),
    "surface_rows": lambda s: about_surfaces(s),
    "field_rows": lambda s: in_fields(s),
    "anchored_rows": lambda s: (
        lambda state: anchored_rows(frames(s, state), *anchors(s), s.target[:, [1, 2, 0]], weight=s.sigma)
    ),
    "target_rows": lambda s: (
        lambda state: target_rows(frames(s, state), *anchors(s)[:2], *in_one_camera(s), slack=3.0, sigma=0.7)
    ),
    "morphed_rows": lambda s: on_a_morphed_skin(s),
    "morphed_outline_rows": lambda s: outlines_of_a_morphed_skin(s),
    "outline_rows": lambda s: outlines_of_random_edges(s),
    "limit_rows": lambda s: lambda state: limit_rows(beyond_limits(s), state, sigma=0.3),
    "prior_rows": lambda s: lambda state: prior_rows(s.body, state, mean=0.2, sigma=prior_sigma(s)),
    "prediction_rows": lambda s: (
        lambda state: prediction_rows(
            s.body, state, s.state.retract(moved(s)), sigma=np.linspace(0.1, 2.0, s.body.tree.n_dofs)
        )
    ),
}


def frames(s, state):
    """Those of the body's segments."""
    return s.body.tree.forward(state.T_world_root, state.angles)[0]


def anchors(s):
    """Segments, points and normals of a surface, at rest."""
    return s.points.segments, s.body.points_rest(s.points), s.normal


def in_one_camera(s):
    """A camera and places in its image some way off the points."""
    camera = s.rig.cameras[1]
    return camera, camera.project(s.x) + np.array([[30.0, -20.0]]) * (1 + np.arange(len(s.x)))[:, None]


def about_surfaces(s):
    """Points inside and outside of an elliptical cylinder on every segment, each known to be of one of them."""
    random, count = np.random.default_rng(4), len(s.body.tree.segments)
    shapes = random.uniform(0.05, 0.15, (count, 2, 2))
    surfaces = tuple(
        TaperedCylinder(k, random.normal(scale=0.05, size=3), (0.0, 0.4, 0.1), shapes[k], random.normal(size=3))
        for k in range(count)
    )
    body, owner = replace(s.body, surfaces=surfaces), np.repeat(np.arange(count), 3)
    points = PointSet(tuple(f"{k}" for k in range(3 * count)), owner, random.normal(scale=0.2, size=(3 * count, 3)))
    x = slow_positions(body, s.state, points)
    return lambda state: surface_rows(body, state, x, segment=owner, max_distance=5.0, sigma=0.7, exact=True)


def in_fields(s):
    """Points in the fields of two metaballs on every segment, each known to be of one of them."""
    random, count = np.random.default_rng(4), len(s.body.tree.segments)
    surfaces = tuple(
        Metaballs.of(k, [[0, 0, 0], [0.02, 0.1, 0]], random.uniform(0.2, 0.4, (2, 3))) for k in range(count)
    )
    body, owner = replace(s.body, surfaces=surfaces), np.repeat(np.arange(count), 3)
    points = PointSet(tuple(f"{k}" for k in range(3 * count)), owner, random.normal(scale=0.2, size=(3 * count, 3)))
    x, sigma = slow_positions(body, s.state, points), random.uniform(0.5, 2.0, 3 * count)
    return lambda state: field_rows(body, state, x, owner, sigma=sigma)


def morphed_skin(s):
    """A skin that morphs, every node blended between three segments."""
    random, tree = np.random.default_rng(5), s.body.tree
    owners = random.integers(0, len(tree.segments), (40, 3))
    nodes = tree.rest[owners] + random.normal(scale=0.2, size=(40, 3, 3))
    skin = SkinnedMesh(nodes, np.zeros((0, 3), int), owners, random.dirichlet(np.ones(3), 40))
    steer = lambda k: Steering(tree.coordinates[k], -20.0, 20.0)
    operators = [
        JointMotion(tree.segments[4], random.normal(size=6), steer(1)),
        LocalMorph(skin.vertices[0], [0.5, 0.5, 0.5], [0.0, 1.0, 2.0], steer(2)),
    ]
    return Morphing(s.body, skin, operators)


def outlines_of_a_morphed_skin(s):
    """Points on edges of a skin that morphs, seen by one camera, towards tangents of an outline."""
    random, morphing, camera = np.random.default_rng(6), morphed_skin(s), s.rig.cameras[1]
    none = np.zeros(30, int)
    rim = Rim(np.zeros((4, 30)), random.integers(0, 40, (30, 2)), random.random(30), none, none > 0)
    uv = camera.project(rim.on(morphing.pose(s.state).vertices)) + random.normal(scale=20, size=(30, 2))
    turn = random.uniform(0, 2 * np.pi, 30)
    image = np.stack([*uv.T, np.cos(turn), np.sin(turn)])
    return lambda state: morphed_outline_rows(morphing.pose(state), rim, camera, image, sigma=3.0)


def outlines_of_random_edges(s):
    """Points on edges of every segment, seen by one camera, towards tangents of an outline."""
    random, tree, camera = np.random.default_rng(6), s.body.tree, s.rig.cameras[1]
    owner = np.repeat(np.arange(len(tree.segments)), 4)
    count = len(owner)
    rest = tree.rest[owner].repeat(2, axis=0) + random.normal(scale=0.2, size=(2 * count, 3))

    def vertices(state):
        f = tree.forward(state.T_world_root, state.angles)[0][owner.repeat(2)]
        return np.einsum("nij,nj->ni", f[:, :9].reshape(-1, 3, 3), rest) + f[:, 9:]

    rim = Rim(np.zeros((4, count)), np.arange(2 * count).reshape(-1, 2), random.random(count), owner, owner < 0)
    uv = camera.project(rim.on(vertices(s.state))) + random.normal(scale=20, size=(count, 2))
    turn = random.uniform(0, 2 * np.pi, count)
    image = np.stack([*uv.T, np.cos(turn), np.sin(turn)])
    return lambda state: outline_rows(s.body, state, rim, vertices(state), camera, image, sigma=3.0)


def on_a_morphed_skin(s):
    """Points between three nodes each of a skin that morphs."""
    random, morphing = np.random.default_rng(5), morphed_skin(s)
    index, share = random.integers(0, 40, (30, 3)), random.random((30, 3))
    share, n = share / share.sum(1, keepdims=True), random_unit(random, 30)
    target = np.einsum("nc,nci->ni", share, morphing.pose(s.state).vertices[index]) + random.normal(size=(30, 3))

    def rows(state):
        pose = morphing.pose(state)
        away = target - np.einsum("nc,nci->ni", share, pose.vertices[index])
        return morphed_rows(pose, index, n, np.sum(n * away, axis=1), share=share, sigma=0.7)

    return rows


def random_capsules(s):
    """A capsule of random place on every segment, each pair of which is to keep apart."""
    random, count = np.random.default_rng(2), len(s.body.tree.segments)
    starts, ends = s.body.tree.rest + random.normal(scale=0.2, size=(2, count, 3))
    pairs = np.array(np.triu_indices(count, 1)).T.copy()
    return CollisionPairs(np.arange(count), starts, ends, np.full(count, 0.05), pairs, np.full(len(pairs), 0.1))


def seen_through(s):
    """Samples of the body's surface, a depth image that looks past all of them, and its camera."""
    random, camera = np.random.default_rng(2), s.rig.cameras[0]
    samples = SurfaceSamples(np.repeat(s.points.segments, 3), random.normal(scale=0.2, size=(3, 3 * len(s.points))),
                             random_unit(random, 3 * len(s.points)).T)  # fmt: skip
    depth = np.full(camera.size[::-1], 1e6, np.float32)
    depth[40:80, 100:150] = 1.0  # the only place where it can be
    return samples, FreeSpace.of(depth, farthest=10.0), camera


def measured_samples(s):
    """Samples of the body's surface, a camera of few pixels (no sample may change its), one depth, nothing hidden."""
    samples, camera = seen_through(s)[0], s.rig.cameras[1].scaled((8, 6))
    depth = np.full(camera.size[::-1], np.linalg.norm(camera.centre_world - s.x.mean(axis=0)), np.float32)
    return samples, camera, depth, np.full((30, 40), np.inf)


def beyond_limits(s):
    """The body with limits that two thirds of its angles at the state are beyond."""
    q, k = s.state.angles, np.arange(len(s.state.angles)) % 3
    tree = replace(s.body.tree, lower=q + np.array([0.2, -1.0, -0.5])[k], upper=q + np.array([0.9, -0.3, 0.5])[k])
    return replace(s.body, tree=tree)


def prior_sigma(s):
    sigma = np.linspace(0.1, 2.0, len(s.state.angles))
    sigma[2] = np.inf
    return sigma


def moved(s):
    """A step to the predicted state; without a turn of the root, of which the rows hold to first order only."""
    delta = 0.3 * np.random.default_rng(1).normal(size=s.body.tree.n_dofs)
    delta[3:6] = 0.0
    return delta


def public_makers():
    """Names of all row makers: public functions named `..._rows` in any module of the package."""
    found = {name for name in correspondences.__all__ if name.endswith("_rows")}
    for module in pkgutil.iter_modules(correspondences.__path__):
        if not module.name.startswith("_"):
            members = vars(importlib.import_module(f"{correspondences.__name__}.{module.name}"))
            found |= {n for n, f in members.items() if n.endswith("_rows") and not n.startswith("_") and callable(f)}
    return sorted(found)


def test_every_row_maker_is_public_and_has_a_case():
    makers = public_makers()
    assert makers == sorted(n for n in correspondences.__all__ if n.endswith("_rows")), "export it in __init__.py"
    assert makers == sorted(CASES), "give every row maker a case in CASES"


BODIES = {"random": lambda: random_body(1, 10), "humanoid": lambda: load_body("humanoid")}


@pytest.fixture(params=BODIES)
def body(request):
    return BODIES[request.param]()


@pytest.mark.parametrize("kind", STATES)
@pytest.mark.parametrize("maker", public_makers())
def test_derivatives_agree_with_central_differences(maker, kind, body):
    """∂(√w r)/∂δ = −√w ∂(n·x)/∂δ, with n·∂x = a J and a = (n, (x − c) × n)."""
    state = state_of(body, kind, seed=3)
    make = CASES[maker](Scene(body, state))
    rows = make(state)
    assert len(rows) >= 6
    expected = central_differences(lambda s: whitened(make(s)), body, state, 1e-5)
    np.testing.assert_allclose(
        -np.sqrt(rows.weight)[:, None] * design(rows, body, state), expected, rtol=1e-6, atol=2e-6
    )


def whitened(rows):
    return np.sqrt(rows.weight) * rows.residual


@pytest.fixture(params=STATES)
def scene(request, body):
    return Scene(body, state_of(body, request.param, seed=3))


def check(rows, points, x, direction, residual, weight, group):
    """Rows are what plain numpy says, in any order."""
    order, other = np.lexsort((residual, group)), np.lexsort((rows.residual, rows.group))
    np.testing.assert_array_equal(rows.group[other], group[order])
    np.testing.assert_array_equal(rows.segment[other], points.segments[group[order]])
    np.testing.assert_allclose(rows.point[other], x[order], atol=1e-10)
    np.testing.assert_allclose(rows.direction[other], direction[order], atol=1e-8)
    np.testing.assert_allclose(np.linalg.norm(rows.direction, axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(rows.residual[other], residual[order], atol=1e-9)
    np.testing.assert_allclose(rows.weight[other], weight[order], rtol=1e-8)


def test_point_rows_in_numpy(scene):
    s, k = scene, np.repeat(np.arange(len(scene.points)), 3)
    axes, gap = np.tile(np.eye(3), (len(s.x), 1)), (s.target - s.x).ravel()
    check(CASES["point_rows"](s)(s.state), s.points, s.x[k], axes, gap, 1 / s.sigma[k] ** 2, k)


def test_plane_rows_in_numpy(scene):
    s, k = scene, np.arange(len(scene.points))
    residual = np.sum(s.normal * (s.target - s.x), axis=1)
    check(CASES["plane_rows"](s)(s.state), s.points, s.x, s.normal, residual, 1 / s.sigma**2, k)


def test_ray_rows_in_numpy(scene):
    """Two directions at right angles to the line and to each other; their residuals are the offset to the line."""
    s = scene
    rows = CASES["ray_rows"](s)(s.state)
    n, m = s.line[:, :3], s.line[:, 3:]
    offset = np.cross(n, np.cross(s.x, n) - m)  # from the line to the point, P3 eq. 4
    a, b = rows.direction[0::2], rows.direction[1::2]
    np.testing.assert_array_equal(rows.group, np.repeat(np.arange(len(s.x)), 2))
    for u, v in ((a, a), (b, b)):
        np.testing.assert_allclose(np.sum(u * v, axis=1), 1, atol=1e-12)
    for u, v in ((a, b), (a, n), (b, n)):
        np.testing.assert_allclose(np.sum(u * v, axis=1), 0, atol=1e-12)
    np.testing.assert_allclose(rows.residual[0::2, None] * a + rows.residual[1::2, None] * b, -offset, atol=1e-11)
    np.testing.assert_allclose(np.hypot(rows.residual[0::2], rows.residual[1::2]),
                               np.linalg.norm(lines.point_line(s.x, s.line), axis=1), atol=1e-11)  # fmt: skip
    np.testing.assert_allclose(rows.weight, np.repeat(1 / s.sigma**2, 2))


def test_pixel_rows_in_opencv(scene):
    s, k = scene, np.repeat(np.arange(len(scene.points)), 2)
    seen = [s.seen(c, x) for c, x in zip(s.camera, s.x, strict=True)]
    g = np.concatenate([J for _, J in seen])
    gap, size = (s.uv - np.array([uv for uv, _ in seen])).ravel(), np.linalg.norm(g, axis=1)
    check(
        CASES["pixel_rows"](s)(s.state), s.points, s.x[k], g / size[:, None], gap / size, size**2 / s.sigma[k] ** 2, k
    )


def image_line_rows_in_opencv(s, points):
    normal = s.image_line[:, :2] / np.linalg.norm(s.image_line[:, :2], axis=1, keepdims=True)
    x = slow_positions(s.body, s.state, points)
    seen = [s.seen(c, v) for c, v in zip(s.camera, x, strict=True)]
    g = np.array([n @ J for n, (_, J) in zip(normal, seen, strict=True)])
    gap = np.sum(normal * (s.uv - np.array([uv for uv, _ in seen])), axis=1)  # the line goes through s.uv
    size = np.linalg.norm(g, axis=1)
    return x, g / size[:, None], gap / size, size**2 / s.sigma**2


def test_image_line_rows_in_opencv(scene):
    s = scene
    x, direction, residual, weight = image_line_rows_in_opencv(s, s.points)
    rows = CASES["image_line_rows"](s)(s.state)
    sign = np.sign(np.sum(rows.direction * direction, axis=1))  # a line has no sides
    check(rows, s.points, x, direction * sign[:, None], residual * sign, weight, np.arange(len(x)))


def test_edge_rows_are_two_image_line_rows_with_one_weight(scene):
    s = scene
    rows = CASES["edge_rows"](s)(s.state)
    np.testing.assert_array_equal(rows.group, np.repeat(np.arange(len(s.x)), 2))  # adjacent: one robust weight
    for side, points in enumerate((s.points, s.others)):
        x, direction, residual, weight = image_line_rows_in_opencv(s, points)
        np.testing.assert_allclose(rows.point[side::2], x, atol=1e-10)
        sign = np.sign(np.sum(rows.direction[side::2] * direction, axis=1))
        np.testing.assert_allclose(rows.residual[side::2] * sign, residual, atol=1e-9)
        np.testing.assert_allclose(rows.weight[side::2], weight, rtol=1e-8)
        np.testing.assert_array_equal(rows.segment[side::2], points.segments)


def test_coincidence_rows_in_numpy(scene):
    s = scene
    rows = CASES["coincidence_rows"](s)(s.state)
    other = slow_positions(s.body, s.state, s.others)
    np.testing.assert_allclose(rows.residual, (other - s.x).ravel(), atol=1e-11)
    np.testing.assert_allclose(rows.weight, np.repeat(1 / s.sigma**2, 3))
    np.testing.assert_array_equal(rows.segments, np.repeat(np.c_[s.points.segments, s.others.segments], 3, axis=0))


def test_limit_rows_are_there_for_what_is_beyond_only():
    body = random_body(0)
    state = state_of(body, "random")
    s = Scene(body, state)
    rows = CASES["limit_rows"](s)(state)
    k = np.arange(len(state.angles))
    assert list(rows.index) == list(6 + k[k % 3 < 2])
    np.testing.assert_allclose(rows.residual, np.where((rows.index - 6) % 3 == 0, 0.2, -0.3), atol=1e-12)
    np.testing.assert_allclose(rows.weight, 1 / 0.09)
    assert len(limit_rows(body, state)) == 0


def test_prior_rows_leave_out_what_has_none():
    body = random_body(0)
    state = state_of(body, "random")
    rows = prior_rows(body, state, mean=0.1, sigma=prior_sigma(Scene(body, state)))
    assert 6 + 2 not in rows.index and len(rows) == len(state.angles) - 1
    np.testing.assert_allclose(rows.residual, 0.1 - state.angles[rows.index - 6])


def test_prediction_rows_turn_the_root_the_short_way():
    body = random_body(0)
    state = state_of(body, "random")
    delta = np.zeros(body.tree.n_dofs)
    delta[3:6] = (3.0, 0.5, -0.2)
    rows = prediction_rows(body, state, state.retract(delta), sigma=np.full(body.tree.n_dofs, 0.5))
    np.testing.assert_allclose(rows.residual, delta, atol=1e-9)
    np.testing.assert_allclose(rows.weight, 4.0)
    held = np.full(body.tree.n_dofs, np.inf)
    held[7] = 1.0
    assert list(prediction_rows(body, state, state, sigma=held).index) == [7]


def test_at_the_truth_nothing_is_left_over(body):
    state = state_of(body, "random", seed=3)
    s = Scene(body, state)
    s.target, s.uv = s.x, s.pixels()
    s.line = lines.line_along(s.x, s.normal)
    s.image_line = np.c_[s.normal[:, :2], -np.sum(s.normal[:, :2] * s.uv, axis=1)]
    for maker in ("point_rows", "plane_rows", "ray_rows", "pixel_rows", "image_line_rows"):
        rows = CASES[maker](s)(state)
        np.testing.assert_allclose(rows.residual, 0, atol=1e-11, err_msg=maker)
    assert np.all(prediction_rows(body, state, state, sigma=np.ones(body.tree.n_dofs)).residual == 0)


@pytest.mark.parametrize(
    "maker", ["point_rows", "plane_rows", "ray_rows", "pixel_rows", "image_line_rows", "edge_rows"]
)
def test_what_was_not_measured_makes_no_row(maker):
    body = random_body(1, 10)
    s = Scene(body, state_of(body, "random", seed=3))
    whole = CASES[maker](s)(s.state)
    lost = [2, 5]
    for name in ("target", "line", "uv", "image_line"):
        getattr(s, name)[lost, 1] = np.nan
    rows = CASES[maker](s)(s.state)
    kept = ~np.isin(whole.group, lost)
    assert not np.isin(rows.group, lost).any() and 0 < kept.sum() < len(whole)
    np.testing.assert_allclose(rows.data, whole.data[:, kept], rtol=1e-12, atol=1e-15)
    np.testing.assert_array_equal(rows.group, whole.group[kept])
    np.testing.assert_array_equal(rows.segment, whole.segment[kept])


@pytest.mark.parametrize("maker", ["pixel_rows", "image_line_rows"])
def test_a_point_behind_its_camera_makes_no_row(maker):
    body = random_body(1, 10)
    s = Scene(body, state_of(body, "random", seed=3))
    behind = s.rig.cameras[0].centre_world - 5 * (s.x.mean(axis=0) - s.rig.cameras[0].centre_world)
    T = np.array(s.state.T_world_root)
    T[:3, 3] += behind - s.x.mean(axis=0)
    rows = CASES[maker](s)(BodyState(T, s.state.angles))
    assert not np.isin(rows.group, np.flatnonzero(s.camera == 0)).any()
    assert np.all(np.isfinite(rows.data))


def bad(maker, match, **changes):
    return pytest.param(maker, changes, match, id=f"{maker}: {next(iter(changes))} {match[:24]}")


@pytest.mark.parametrize(
    ("maker", "changes", "match"),
    [
        bad("point_rows", r"shape \(13, 3\).*Give \(14, 3\)", target=np.zeros((13, 3))),
        bad("point_rows", "must be positive", sigma=0.0),
        bad("point_rows", "must be positive", sigma=np.nan),
        bad("plane_rows", "must be positive", sigma=-1.0),
        bad("plane_rows", "unit", normal=np.tile([0.0, 0.0, 2.0], (14, 1))),
        bad("plane_rows", "unit", normal=np.zeros((14, 3))),
        bad("ray_rows", "unit", line=np.tile([0.0, 0.0, 2.0, 0.0, 0.0, 0.0], (14, 1))),
        bad("ray_rows", r"shape \(14, 3\)", line=np.zeros((14, 3))),
        bad("pixel_rows", r"camera.*0 to 2", camera=np.full(14, 3)),
        bad("pixel_rows", r"camera.*0 to 2", camera=np.full(14, -1)),
        bad("pixel_rows", "camera", camera=np.zeros(5, int)),
        bad("pixel_rows", r"shape \(14, 3\)", uv=np.zeros((14, 3))),
        bad("image_line_rows", r"camera.*0 to 2", camera=np.full(14, 3)),
        bad("edge_rows", "camera", camera=np.zeros(5, int)),
        bad("coincidence_rows", "must be positive", sigma=0.0),
        bad(
            "coincidence_rows", "14.*13", others=random_body(1, 10).landmarks.select(tuple(f"p{i}" for i in range(13)))
        ),
    ],
)
def test_what_cannot_be_used_is_told(maker, changes, match):
    body = random_body(1, 10)
    s = Scene(body, state_of(body, "random", seed=3))
    vars(s).update(changes)
    with pytest.raises(KinefitError, match=match):
        CASES[maker](s)(s.state)


def test_spreads_of_degrees_of_freedom_must_be_positive():
    body = random_body(0)
    state, n = state_of(body, "random"), body.tree.n_dofs
    for sigma in (0.0, -1.0, np.nan):
        with pytest.raises(KinefitError, match="must be positive"):
            limit_rows(body, state, sigma=sigma)
        with pytest.raises(KinefitError, match="must be positive"):
            prior_rows(body, state, sigma=sigma)
        with pytest.raises(KinefitError, match="must be positive"):
            prediction_rows(body, state, state, sigma=np.full(n, sigma))
    with pytest.raises(KinefitError, match=rf"shape \(3,\).*Give \({n},\)"):
        prediction_rows(body, state, state, sigma=np.ones(3))


def test_one_camera_for_all_points():
    body = random_body(1, 10)
    s = Scene(body, state_of(body, "random", seed=3))
    each = pixel_rows(body, s.state, s.points, s.rig, np.full(len(s.points), 1), s.uv)
    np.testing.assert_array_equal(pixel_rows(body, s.state, s.points, s.rig, 1, s.uv).data, each.data)
