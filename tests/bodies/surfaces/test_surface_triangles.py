"""Surfaces as triangles and as points spread over them."""

from dataclasses import replace

import numpy as np
import pytest
from tests.bodies.surfaces.shapes import box
from tests.oracle import STATES, state_of

from kinefit.bodies import load_body
from kinefit.bodies.surfaces import MeshSurface, TaperedCylinder, triangles
from kinefit.bodies.surfaces.places import body_mesh, sample
from kinefit.errors import BodyError
from kinefit.geometry import se3

CYLINDER = TaperedCylinder(0, (0.01, 0.0, 0.02), (0.05, 0.4, -0.03), ((0.1, 0.06), (0.05, 0.08)), (1.0, 0.2, 0.3))


def volume(vertices, faces):
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return np.einsum("ti,ti->", a, np.cross(b, c)) / 6.0


def level(cylinder, points):
    """p²/a² + q²/b² at each point's height: 1 on the side; and the height as a share of the length."""
    p, q, h = ((points - cylinder.start) @ cylinder.axes.T).T
    t = h / cylinder.length
    (a0, b0), (a1, b1) = cylinder.radii
    return (p / (a0 + t * (a1 - a0))) ** 2 + (q / (b0 + t * (b1 - b0))) ** 2, t


@pytest.mark.parametrize(("around", "along"), [(3, 1), (8, 2), (20, 6)])
def test_a_cylinder_is_closed_outward_and_as_large_as_it_should_be(around, along):
    v, f = triangles(CYLINDER, around, along)
    mesh = MeshSurface(0, v, f)  # refuses holes and flipped faces
    assert mesh.open_edges == 0 and len(f) == 2 * around * (along + 1)
    (a0, b0), (a1, b1) = CYLINDER.radii
    exact = np.pi * CYLINDER.length * (a0 * b0 / 3 + (a0 * b1 + a1 * b0) / 6 + a1 * b1 / 3)
    assert volume(v, f) == pytest.approx(exact, rel=0.03 if around > 3 else 0.2)


def test_corners_stand_out_by_less_than_a_hundredth():
    v, _ = triangles(CYLINDER, 20, 6)
    on, t = level(CYLINDER, v[:-2])
    assert (on > 1.0).all() and (on < 1.02).all() and t.min() == pytest.approx(0, abs=1e-12)


def test_a_cylinder_of_no_triangles_is_refused():
    with pytest.raises(BodyError, match="2 corners"):
        triangles(CYLINDER, 2)


@pytest.mark.parametrize("kind", STATES)
def test_a_posed_mesh_follows_its_segments(kind):
    body = load_body("humanoid")
    mesh, state = body_mesh(body), state_of(body, kind)
    frames, _ = body.tree.forward(state.T_world_root, state.angles)
    Ts = body.tree.segment_poses(state.T_world_root[None], state.angles[None])[0]
    expected = se3.apply(Ts[mesh.segment], mesh.vertices - body.tree.rest[mesh.segment])
    np.testing.assert_allclose(mesh.posed(frames), expected, atol=1e-12)
    np.testing.assert_array_equal(mesh.segment[mesh.faces].T, np.tile(mesh.face_segment, (3, 1)))
    assert mesh.faces.dtype == mesh.segment.dtype == mesh.face_segment.dtype == np.int32


def test_segments_with_several_surfaces_and_without_any():
    body = load_body("humanoid10")
    surfaces = (replace(CYLINDER, segment=2), MeshSurface(1, *box((0.1, 0.1, 0.1))), replace(CYLINDER, segment=2))
    mesh = body_mesh(replace(body, surfaces=surfaces), around=5, along=1)
    assert np.bincount(mesh.face_segment).tolist() == [0, 12, 40]
    state = body.default_state()
    frames, _ = body.tree.forward(state.T_world_root, state.angles)
    assert np.isfinite(mesh.posed(frames)).all()
    with pytest.raises(BodyError, match="no surfaces"):
        body_mesh(replace(body, surfaces=()))


def test_samples_lie_on_the_surfaces_with_equal_density():
    body = load_body("humanoid10")
    boxed = MeshSurface(1, *box((0.2, 0.3, 0.4)))
    body = replace(body, surfaces=(replace(CYLINDER, segment=2), boxed))
    points, normals, segment = sample(body, 4000, seed=1)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-12)
    local = points - body.tree.rest[segment]
    on, t = level(CYLINDER, local[segment == 2])
    caps = (t < 1e-9) | (t > 1 - 1e-9)
    np.testing.assert_allclose(on[~caps], 1.0, atol=1e-9)
    assert caps.any() and (on[caps] < 1.002).all()
    n = normals[segment == 2]
    np.testing.assert_allclose(n[caps], np.where(t[caps] > 0.5, 1, -1)[:, None] * CYLINDER.axes[2], atol=1e-9)
    h = 1e-6  # the normal of the side is the gradient of its level
    slope = np.stack([level(CYLINDER, local[segment == 2] + h * e)[0] for e in np.eye(3)], 1) - on[:, None]
    slope /= np.linalg.norm(slope, axis=1, keepdims=True)
    np.testing.assert_allclose(n[~caps], slope[~caps], atol=1e-4)
    inside = np.abs(local[segment == 1]) <= [0.1 + 1e-12, 0.15 + 1e-12, 0.2 + 1e-12]
    assert inside.all() and (np.abs(local[segment == 1] / [0.1, 0.15, 0.2]).max(1) > 1 - 1e-9).all()
    sides = np.argmax(np.abs(normals[segment == 1]), 1)  # areas 0.24, 0.16, 0.12 of 0.52 m²
    np.testing.assert_allclose(np.bincount(sides) / len(sides), np.array([0.24, 0.16, 0.12]) / 0.52, atol=0.01)
    share = 0.52 / (0.52 + _area(CYLINDER))
    assert np.mean(segment == 1) == pytest.approx(share, abs=0.005)


def test_samples_are_those_of_their_seed():
    body = load_body("humanoid")
    one, two, three = sample(body, 100), sample(body, 100), sample(body, 100, seed=1)
    np.testing.assert_array_equal(one[0], two[0])
    assert not np.array_equal(one[0], three[0]) and sample(body, 0)[0].shape == (0, 3)


def _area(cylinder):
    v, f = triangles(cylinder, 200, 100)
    c = v[f]
    return 0.5 * np.linalg.norm(np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]), axis=1).sum()
