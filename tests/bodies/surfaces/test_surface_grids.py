"""Distance grids of meshes against closed forms and a slow search over all triangles."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.bodies.surfaces.shapes import ball, box, brute_force, points_on

from kinefit.bodies.surfaces import MeshSurface
from kinefit.bodies.surfaces.closest import _kernels_grid as kernels
from kinefit.bodies.surfaces.closest.grid import distance_grid, features_of, parts
from kinefit.bodies.surfaces.mesh import pack_grids, read_obj

HERE = np.array([[1.0, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0]])


def search(surfaces, x, *, frames=HERE, rest=None, bound=10.0, only=None, best=None):
    rest = np.zeros((len(frames), 3)) if rest is None else rest
    best = np.full(len(x), bound) if best is None else best
    normal, segment = np.zeros((3, len(x))), np.full(len(x), -1)
    only = np.full(len(x), -1) if only is None else only
    x_soa = np.ascontiguousarray(x.T)
    kernels.nearest_on_grids(x_soa, frames, *pack_grids(surfaces, rest), only, best, normal, segment)
    return best, normal.T, segment


def test_closest_point_of_a_triangle_is_that_of_a_dense_search():
    rng = np.random.default_rng(0)
    u, v = np.meshgrid(np.linspace(0, 1, 201), np.linspace(0, 1, 201))
    u, v = u[u + v <= 1.0 + 1e-12], v[u + v <= 1.0 + 1e-12]
    met = set()
    for _ in range(200):
        a, b, c, p = rng.normal(size=(4, 3))
        *q, feature = kernels.closest_on_triangle(*p, a, b, c)
        met.add(feature)
        samples = a + u[:, None] * (b - a) + v[:, None] * (c - a)
        least = np.linalg.norm(samples - p, axis=1).min()
        assert least - 0.03 < np.linalg.norm(q - p) <= least + 1e-12
        weights = np.linalg.lstsq(np.stack([b - a, c - a], 1), np.array(q) - a, rcond=None)[0]
        np.testing.assert_allclose(a + weights @ [b - a, c - a], q, atol=1e-12)
        assert weights.min() > -1e-12 and weights.sum() < 1 + 1e-12
    assert met == set(range(7))


def test_a_ball_is_found_to_a_fraction_of_a_cell():
    radius = 0.1
    mesh = MeshSurface(0, *ball(radius, around=80))
    rng = np.random.default_rng(1)
    direction = rng.normal(size=(3000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    x = direction * rng.uniform(0.03, 0.4, (3000, 1))  # also beyond the grid
    best, normal, segment = search([mesh], x)
    assert (segment == 0).all()
    error = np.abs(best - np.linalg.norm(x, axis=1) + radius)
    turned = np.arccos(np.clip(np.sum(normal * direction, 1), -1, 1))
    within = np.linalg.norm(x, axis=1) < radius + 0.14  # [m] inside of the grid
    assert error[within].max() < 0.3e-3 and turned[within].max() < np.radians(4.0)
    assert error.max() < 3e-3 and turned.max() < np.radians(4.0)  # beyond it
    np.testing.assert_allclose(np.linalg.norm(x - best[:, None] * normal, axis=1), radius, atol=1e-3)


def test_every_node_is_exact_near_the_surface_and_no_sign_is_wrong():
    vertices, faces = box((0.3, 0.2, 0.1))
    grid = distance_grid(vertices, faces, cells=32)
    index = np.moveaxis(np.indices(grid.values.shape[:3]), 0, -1)
    x = grid.origin + grid.cell * index
    q = np.abs(x) - np.array([0.15, 0.1, 0.05])
    expected = np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0)
    d = grid.values[..., 0]
    np.testing.assert_allclose(d, expected, atol=1e-6)
    outside = expected > 1e-6
    closest, half = x - d[..., None] * grid.values[..., 1:], np.array([0.15, 0.1, 0.05])
    np.testing.assert_allclose(closest[outside], np.clip(x, -half, half)[outside], atol=1e-6)
    assert (grid.lower == [-0.15, -0.1, -0.05]).all() and (x[0, 0, 0] < grid.lower - 0.14).all()


def test_overlapping_parts_are_their_union():
    one, two = ball(0.1), ball(0.1, at=(0.12, 0.0, 0.0))
    mesh = MeshSurface(0, np.concatenate([one[0], two[0]]), np.concatenate([one[1], two[1] + len(one[0])]))
    assert sorted(map(len, parts(mesh.faces))) == [len(one[1]), len(two[1])]
    x = np.array([[0.06, 0, 0], [0.06, 0, 0.05], [-0.2, 0, 0], [0.3, 0, 0]])
    best, _, _ = search([mesh], x)
    np.testing.assert_allclose(best, [-0.04, np.hypot(0.06, 0.05) - 0.1, 0.1, 0.08], atol=2e-3)


@pytest.mark.parametrize("name", ["farm", "head", "shin", "torso"])
def test_limbs_of_the_rendered_scene(data_dir, name):
    vertices, faces = read_obj(data_dir("scene_body10") / "meshes" / f"{name}.obj")
    mesh, rng = MeshSurface(0, vertices, faces), np.random.default_rng(0)
    p, n = points_on(vertices, faces, 150, rng)
    x = p + n * rng.uniform(-0.02, 0.1, (150, 1))
    expected, closest = brute_force(x, vertices, faces)
    keep = expected > (-0.02 if len(parts(faces)) == 1 else 1e-3)  # inside of two parts, a search finds inner walls
    best, normal, _ = search([mesh], x)
    error = np.abs(best - expected)[keep]
    assert error.mean() < 0.25e-3 and np.quantile(error, 0.95) < 1e-3
    assert np.median(np.linalg.norm(x - best[:, None] * normal - closest, axis=1)[keep]) < 2e-3
    solid = keep & (np.abs(expected) > 1e-3)
    assert (np.sign(best) == np.sign(expected))[solid].all()


def test_moved_segments_bounds_and_chosen_ones():
    rng = np.random.default_rng(2)
    mesh = MeshSurface(0, *box((0.3, 0.2, 0.1)))
    surfaces, rest = [mesh, mesh.on(2)], rng.normal(size=(3, 3))
    R, t = Rotation.random(3, random_state=3).as_matrix(), rng.normal(size=(3, 3))
    frames = np.concatenate([R.reshape(3, 9), t], axis=1)
    local = rng.uniform(-0.2, 0.2, (400, 3))
    alone = search([mesh], local)
    for s in (0, 2):
        world = (local + rest[s]) @ R[s].T + t[s]
        best, normal, segment = search(surfaces, world, frames=frames, rest=rest, only=np.full(400, s))
        assert (segment == s).all()
        np.testing.assert_allclose(best, alone[0], atol=1e-9)
        np.testing.assert_allclose(normal, alone[1] @ R[s].T, atol=1e-6)
        near = search(surfaces, world, frames=frames, rest=rest, bound=0.03)
        assert ((near[2] == s) == (np.abs(alone[0]) < 0.03)).all()
        np.testing.assert_array_equal(near[0][near[2] < 0], 0.03)
    nothing = search(surfaces, local, frames=frames, rest=rest, only=np.full(400, 1))
    assert (nothing[2] == -1).all()
    assert len(pack_grids(surfaces, rest).values) == np.prod(mesh.grid.values.shape[:3])  # shared


def test_only_what_is_nearer_is_replaced():
    mesh = MeshSurface(0, *box((0.2, 0.2, 0.2)))
    x = np.array([[0.15, 0.0, 0.0], [0.15, 0.0, 0.0], [0.07, 0.0, 0.0]])
    best, _, segment = search([mesh], x, best=np.array([0.04, -0.06, 0.02]))
    np.testing.assert_allclose(best, [0.04, 0.05, 0.02], atol=1e-6)
    assert segment.tolist() == [-1, 0, -1]


def test_the_normal_is_the_gradient_of_the_distance():
    mesh = MeshSurface(0, *ball(0.1, around=80))
    x = np.random.default_rng(3).uniform(-0.15, 0.15, (300, 3))
    x = x[np.linalg.norm(x, axis=1) > 0.04]
    _, normal, _ = search([mesh], x)
    h = 2e-3
    slope = np.stack([search([mesh], x + h * e)[0] - search([mesh], x - h * e)[0] for e in np.eye(3)], 1) / (2 * h)
    assert np.quantile(np.linalg.norm(slope - normal, axis=1), 0.95) < 0.06


def test_a_stretched_mesh_takes_its_grid_along():
    mesh = MeshSurface(0, *ball(0.1))
    assert mesh.grid is mesh.grid
    larger = mesh.scaled(1.5)
    assert "grid" in larger.__dict__ and "grid" not in MeshSurface(0, *ball(0.1)).scaled(1.5).__dict__
    best, _, _ = search([larger], np.array([[0.2, 0.0, 0.0], [0.0, 0.1, 0.0]]))
    np.testing.assert_allclose(best, [0.05, -0.05], atol=1e-3)
    assert replace(mesh, segment=0).grid is not None


def test_weighted_normals_of_a_cube_point_along_its_diagonals():
    vertices, faces = box((1.0, 1.0, 1.0))
    features, across = features_of(vertices, faces)
    for face, beyond in zip(faces, across):
        shared = [set(face) & set(faces[k]) for k in beyond]
        assert shared == [{face[0], face[1]}, {face[1], face[2]}, {face[2], face[0]}]
    for corner in (1, 2, 3):
        diagonal = np.sign(vertices[faces[:, corner - 1]]) / np.sqrt(3)
        np.testing.assert_allclose(features[:, corner], diagonal, atol=1e-12)
    between = {tuple(np.round(np.sort(np.abs(n)), 6)) for n in features[:, 4:].reshape(-1, 3)}
    assert between == {(0.0, 0.0, 1.0), (0.0, 0.707107, 0.707107)}  # diagonals of sides; edges of the cube


def test_no_meshes_no_grids():
    best, _, segment = search([], np.zeros((3, 3)), bound=0.1)
    assert (best == 0.1).all() and (segment == -1).all()
