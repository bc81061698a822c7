"""Anchors: points of surfaces in the surfaces' own coordinates."""

from dataclasses import replace

import numpy as np
import pytest
from tests.bodies.surfaces.shapes import ball, points_on

from kinefit.bodies import MeshSurface, TaperedCylinder, load_body
from kinefit.bodies.surfaces.closest._kernels_grid import nearest_faces
from kinefit.bodies.surfaces.places import SurfaceAnchors, sample
from kinefit.errors import BodyError

BODY = load_body("humanoid")


@pytest.fixture(scope="module")
def body():
    """Cylinders, two on some segments, and a ball on the head."""
    v, f = ball(0.09, (0.0, 0.1, 0.0), around=16)
    head = BODY.tree.segment("head")
    return replace(BODY, surfaces=(*(s for s in BODY.surfaces if s.segment != head), MeshSurface(head, v, f)))


@pytest.fixture(scope="module")
def anchors(body):
    points, normals, segment = sample(body, 2000)
    return SurfaceAnchors(body, segment.astype(np.int64), points, normals)


def test_on_a_copy_of_the_body_they_are_where_they_were(body, anchors):
    assert anchors.on(body)[0] is anchors.points
    points, normals = anchors.on(replace(body, name="twin"))
    np.testing.assert_allclose(points, anchors.points, atol=1e-12)
    np.testing.assert_allclose(normals, anchors.normals, atol=1e-12)
    assert len(anchors) == 2000


def test_points_beside_the_surface_come_back_too(body, anchors):
    beside = SurfaceAnchors(body, anchors.segment, anchors.points + 0.01 * anchors.normals, anchors.normals)
    np.testing.assert_allclose(beside.on(replace(body, name="twin"))[0], beside.points, atol=1e-12)


def test_a_scaled_body_moves_them_as_its_surfaces_move(body, anchors):
    """Each in its segment's frame by the segment's scale; normals of what is stretched evenly stay."""
    factors = np.linspace(0.8, 1.3, len(body.scale_groups))
    other = body.scaled(factors)
    points, normals = anchors.on(other)
    own = anchors.segment
    expected = (anchors.points - body.tree.rest[own]) * factors[body.segment_scale[own]][:, None] + other.tree.rest[own]
    np.testing.assert_allclose(points, expected, atol=1e-12)
    np.testing.assert_allclose(normals, anchors.normals, atol=1e-12)


def test_on_other_shapes_they_stay_on_the_surface_with_its_normal():
    """Against the side's own formula: at the same height and eccentric angle of a cylinder of other numbers."""
    one = TaperedCylinder(0, (0.0, 0.0, 0.0), (0.0, 0.4, 0.0), ((0.05, 0.08), (0.1, 0.06)))
    two = TaperedCylinder(0, (0.1, 0.0, 0.0), (0.1, 0.3, 0.4), ((0.09, 0.07), (0.04, 0.12)), (1.0, 0.0, 0.0))
    random = np.random.default_rng(0)
    t, angle = random.random(200), random.uniform(-np.pi, np.pi, 200)

    def on(c):
        (a0, b0), (a1, b1) = c.radii
        a, b, ga, gb = a0 + t * (a1 - a0), b0 + t * (b1 - b0), (a1 - a0) / c.length, (b1 - b0) / c.length
        x = np.stack([a * np.cos(angle), b * np.sin(angle), t * c.length], 1) @ c.axes + c.start
        n = np.stack([np.cos(angle) / a, np.sin(angle) / b,
                      -(np.cos(angle) ** 2 * ga / a + np.sin(angle) ** 2 * gb / b)], 1)  # fmt: skip
        return x, n / np.linalg.norm(n, axis=1, keepdims=True) @ c.axes

    bodies = [replace(BODY, surfaces=(c,)) for c in (one, two)]
    anchors = SurfaceAnchors(bodies[0], np.zeros(200, np.int64), *on(one))
    points, normals = anchors.on(bodies[1])
    np.testing.assert_allclose(points, on(two)[0] + BODY.tree.rest[0], atol=1e-12)
    np.testing.assert_allclose(normals, on(two)[1], atol=1e-12)
    assert anchors.on(bodies[1])[0] is points  # asked again, not made again


def test_nearest_faces_are_those_of_a_search_over_all():
    v, f = ball(0.2, around=12)
    random = np.random.default_rng(0)
    x, _ = points_on(v, f, 100, random)
    x = x + 0.02 * random.normal(size=x.shape)
    corners, face, square = np.ascontiguousarray(v[f]), np.empty(100, np.int64), np.empty(100)
    nearest_faces(corners, x, face, square)
    alone, one, each = np.empty((100, len(f))), np.empty(100, np.int64), np.empty(100)
    for t in range(len(f)):
        nearest_faces(corners[t : t + 1], x, one, each)
        alone[:, t] = each
    np.testing.assert_array_equal(square, alone.min(axis=1))
    np.testing.assert_array_equal(alone[np.arange(100), face], square)


def test_bodies_of_another_make_are_refused(body, anchors):
    head = body.surfaces[-1]
    for surfaces in (
        body.surfaces[:-1],
        (*body.surfaces[1:], body.surfaces[0]),
        (*body.surfaces[:-1], MeshSurface(head.segment, *ball(0.09, around=12))),
    ):
        with pytest.raises(BodyError, match="do not correspond"):
            anchors.on(replace(body, surfaces=surfaces))
    bare = replace(body, surfaces=body.surfaces[:-1])
    lost = SurfaceAnchors(bare, np.full(1, head.segment), np.zeros((1, 3)), np.eye(3)[:1])
    with pytest.raises(BodyError, match="'head' has no surface"):
        lost.on(replace(bare, name="twin"))
