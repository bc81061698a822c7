"""Rims of a body by a virtual image, and the pairing of outlines."""

from dataclasses import dataclass

import numpy as np
import pytest

from kinefit.bodies import load_body
from kinefit.bodies.surfaces.places import body_mesh
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera
from kinefit.solving.correspondences.contours.outlines import RimFinder, outline_pairs, outline_rows


@dataclass
class Balls:
    """Spheres as triangles, each a segment."""

    centres: tuple
    radius: float = 0.2

    def __post_init__(self):
        n, m = 48, 24
        a, b = np.meshgrid(2 * np.pi * np.arange(n) / n, np.pi * (np.arange(m) + 0.5) / m)
        ball = np.stack([np.sin(b) * np.cos(a), np.sin(b) * np.sin(a), np.cos(b)], -1).reshape(-1, 3)
        i = np.arange(m - 1)[:, None] * n + np.arange(n)
        j = np.arange(m - 1)[:, None] * n + (np.arange(n) + 1) % n
        sides = np.concatenate([np.stack([i, i + n, j], -1), np.stack([j, i + n, j + n], -1)]).reshape(-1, 3)
        count = len(ball)
        top = [(count, k, (k + 1) % n) for k in range(n)]
        low = [(count + 1, (m - 1) * n + (k + 1) % n, (m - 1) * n + k) for k in range(n)]
        ball = np.concatenate([ball, [(0, 0, 1), (0, 0, -1)]])
        faces = np.concatenate([sides, top, low])
        self.vertices = np.concatenate([self.radius * ball + c for c in self.centres])
        self.faces = np.concatenate([faces + k * len(ball) for k in range(len(self.centres))])
        self.face_segment = np.repeat(np.arange(len(self.centres)), len(faces))


def camera(size=(320, 240), f=250.0, distortion=()):
    K = [[f, 0, size[0] / 2 - 0.5], [0, f, size[1] / 2 - 0.5], [0, 0, 1]]
    return Camera("c", size, K, distortion)


def test_the_rim_of_a_ball_is_where_rays_touch_it():
    mesh, view = Balls(((0.1, -0.05, 2.0),)), camera()
    rim = RimFinder(mesh).find(mesh.vertices, view, spacing=2.0)
    x = rim.on(mesh.vertices)
    assert len(rim) > 60 and not rim.inner.any()
    away = np.linalg.norm(x - mesh.centres[0], axis=1)
    assert np.abs(away - 0.2).max() < 0.002
    across = np.einsum("ij,ij->i", x - mesh.centres[0], x) / np.linalg.norm(x, axis=1)
    assert np.abs(across).max() < 0.04, "at right angles to the ray, but for the size of the triangles"
    np.testing.assert_allclose(view.project(x), rim.outline[:2].T, atol=1e-6)
    middle = view.project(np.array(mesh.centres[0]))
    outwards = rim.outline[:2].T - middle
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    assert (np.sum(outwards * rim.outline[2:].T, axis=1) > 0.95).all()


def test_lenses_bend_rims():
    mesh, bent = Balls(((0.5, 0.3, 2.0),)), camera(distortion=(-0.2, 0.05, 0.001, 0.0))
    rim = RimFinder(mesh).find(mesh.vertices, bent)
    np.testing.assert_allclose(bent.project(rim.on(mesh.vertices)), rim.outline[:2].T, atol=0.05)


def test_one_ball_before_another_has_an_inner_outline_and_the_other_is_hidden_there():
    mesh, view = Balls(((0.0, 0.0, 2.0), (0.25, 0.0, 3.0))), camera()
    rim = RimFinder(mesh).find(mesh.vertices, view, spacing=1.0)
    assert set(rim.segment[rim.inner]) == {0}
    assert (rim.outline[0][rim.inner] > 160).all(), "on the side where the other ball is"
    back = rim.outline[:2, rim.segment == 1]
    front = np.linalg.norm(back - view.project(np.array(mesh.centres[0]))[:, None], axis=0)
    assert len(front) > 20 and (front > 250 * 0.2 / 2.0 - 1.0).all()


def test_creases_between_parts_are_no_outlines():
    mesh = Balls(((-0.05, 0.0, 2.0), (0.05, 0.0, 2.0)))
    rim = RimFinder(mesh).find(mesh.vertices, camera(), spacing=1.0)
    assert rim.inner.mean() < 0.05 and set(rim.segment) == {0, 1}


def test_what_is_beside_or_behind_the_camera_has_no_rim():
    mesh = Balls(((0.0, 0.0, -2.0), (5.0, 0.0, 2.0)))
    assert len(RimFinder(mesh).find(mesh.vertices, camera())) == 0


def slow_pairs(rim, image, reach, angle):
    """Nearest points that look the same way, one by one."""
    d = np.linalg.norm(rim[:2, :, None] - image[:2, None], axis=0)
    c = np.einsum("ni,nk->ik", rim[2:], image[2:])
    value = np.where((d <= reach) & (c >= np.cos(angle)), d**2 * (2 - c), np.inf)
    return value


@pytest.mark.parametrize("both", [True, False])
def test_pairs_are_the_nearest_that_look_the_same_way(both):
    random = np.random.default_rng(0)
    turn = random.uniform(0, 2 * np.pi, (2, 60))
    sides = [np.stack([*random.uniform(0, 100, (2, 60)), np.cos(t), np.sin(t)]) for t in turn]
    i, k = outline_pairs(*sides, reach=25.0, angle=1.0, both=both)
    value = slow_pairs(*sides, 25.0, 1.0)
    first = np.flatnonzero(np.isfinite(value).any(axis=1))
    np.testing.assert_array_equal(i[: len(first)], first)
    np.testing.assert_array_equal(k[: len(first)], value[first].argmin(axis=1))
    second = np.flatnonzero(np.isfinite(value).any(axis=0))
    assert len(i) == len(first) + (len(second) if both else 0)
    if both:
        np.testing.assert_array_equal(k[len(first) :], second)
        np.testing.assert_array_equal(i[len(first) :], value[:, second].argmin(axis=0))


def test_rows_by_rays_and_by_pixels_tell_of_one_distance():
    body = load_body("humanoid")
    state, view = body.default_state(), camera().with_pose(
        np.array([[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 3.0], [0, 0, 0, 1]])
    )
    mesh = body_mesh(body)
    x = mesh.posed(body.tree.forward(state.T_world_root, state.angles)[0])
    rim = RimFinder(mesh).find(x, view)
    shifted = rim.outline.copy()
    shifted[:2] += 2.0 * shifted[2:]  # two pixels further out everywhere
    given = (body, state, rim, x, view, shifted)
    pixels = outline_rows(*given, sigma=1.0)
    np.testing.assert_allclose(pixels.weight * pixels.residual**2, 4.0, rtol=1e-6)
    rays = outline_rows(*given, sigma=1.0, by="rays")
    square = np.bincount(rays.group, rays.weight * rays.residual**2)
    np.testing.assert_allclose(square, 4.0, rtol=0.4)  # the image's plane is not at right angles to its outer rays
    for wrong in ({"by": "lines"}, {"sigma": 0.0}):
        with pytest.raises(ObservationError):
            outline_rows(*given, **wrong)
