"""Contours and surfaces as Fourier series: through their samples, equal to P1's form, smooth when cut."""

import numpy as np
import pytest

from kinefit.bodies import load_body
from kinefit.bodies.surfaces import MeshSurface
from kinefit.bodies.surfaces.fourier import FourierCurve, FourierSurface, by_length, conformal, levels
from kinefit.errors import BodyError

random = np.random.default_rng(0)
RINGS = [(True, True), (False, True), (True, False), (False, False)]


def trunk(first=24, second=33):
    """A trunk-like surface: rings (closed) that change along a height with two ends; its grid of points."""
    turn, height = 2 * np.pi * np.arange(first)[:, None] / first, np.linspace(0, 0.6, second)[None]
    radius = 0.15 + 0.04 * np.sin(7 * height) + 0.01 * np.cos(5 * turn)
    x, y, z = np.broadcast_arrays(1.3 * radius * np.cos(turn), radius * np.sin(turn), height)
    return np.stack([x, y, z], -1)


@pytest.mark.parametrize("count", [3, 4, 9, 10, 64])
def test_a_curve_goes_through_its_samples(count):
    points = random.normal(size=(count, 3))
    curve = FourierCurve.of(points)
    assert curve.order == count // 2
    np.testing.assert_allclose(curve.at(np.arange(count) / count), points, atol=1e-12)
    np.testing.assert_allclose(curve.samples(count), points, atol=1e-12)
    for other in (2, 5, 50, 101):  # fewer than the frequencies too
        np.testing.assert_allclose(curve.samples(other), curve.at(np.arange(other) / other), atol=1e-12)
    np.testing.assert_allclose(curve.at([0.3, 1.3, -0.7]), np.repeat(curve.at([0.3]), 3, 0), atol=1e-11)


def test_derivatives_of_a_curve():
    curve, u, h = FourierCurve.of(random.normal(size=(12, 3))), random.random(9), 1e-6
    np.testing.assert_allclose(curve.at(u, 1), (curve.at(u + h) - curve.at(u - h)) / (2 * h), rtol=1e-6, atol=1e-6)
    second = (curve.at(u + h, 1) - curve.at(u - h, 1)) / (2 * h)
    np.testing.assert_allclose(curve.at(u, 2), second, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("count", [9, 10])
def test_a_curve_is_the_sum_of_the_paper(count):
    curve, u = FourierCurve.of(random.normal(size=(count, 3))), random.uniform(-2, 2, (4, 6))
    for shape in (curve, curve.low_pass(2), curve.low_pass(0)):
        found = np.moveaxis(conformal(shape, u).values, 0, -1)
        np.testing.assert_allclose(found, shape.at(u), atol=1e-10)


def test_phase_vectors_lie_in_their_planes_and_are_conjugate():
    p = FourierCurve.of(random.normal(size=(9, 3))).phase_vectors.values  # (xyz, signal, k)
    for m in range(3):
        np.testing.assert_array_equal(p[(m + 2) % 3, m], 0)
        np.testing.assert_allclose(p[m, m], p[m, m, ::-1], atol=1e-15)
        np.testing.assert_allclose(p[(m + 1) % 3, m], -p[(m + 1) % 3, m, ::-1], atol=1e-15)


@pytest.mark.parametrize("closed", RINGS)
@pytest.mark.parametrize("counts", [(7, 9), (8, 6), (3, 4)])
def test_a_surface_goes_through_its_samples(closed, counts):
    grid = random.normal(size=(*counts, 3))
    surface = FourierSurface.of(grid, closed=closed)
    np.testing.assert_allclose(surface.samples(counts), grid, atol=1e-12)
    u1, u2 = surface.parameters(counts)
    np.testing.assert_allclose(surface.at(u1[:, None], u2), grid, atol=1e-12)
    finer = surface.parameters((21, 14))
    np.testing.assert_allclose(surface.samples((21, 14)), surface.at(finer[0][:, None], finer[1]), atol=1e-12)


@pytest.mark.parametrize("closed", RINGS)
def test_a_surface_is_the_sum_of_the_paper(closed):
    surface = FourierSurface.of(random.normal(size=(6, 7, 3)), closed=closed)
    u1, u2 = random.uniform(-1, 1, (2, 3, 5))
    for shape in (surface, surface.low_pass(2), surface.low_pass(1, 3)):
        found = np.moveaxis(conformal(shape, u1, u2).values, 0, -1)
        np.testing.assert_allclose(found, shape.at(u1, u2), atol=1e-10)


def test_derivatives_and_normals_of_a_surface():
    surface, h = FourierSurface.of(trunk(), closed=(True, False)), 1e-6
    u1, u2 = random.random(20), random.uniform(0.05, 0.45, 20)
    by_u1 = (surface.at(u1 + h, u2) - surface.at(u1 - h, u2)) / (2 * h)
    by_u2 = (surface.at(u1, u2 + h) - surface.at(u1, u2 - h)) / (2 * h)
    np.testing.assert_allclose(surface.at(u1, u2, (1, 0)), by_u1, atol=1e-7)
    np.testing.assert_allclose(surface.at(u1, u2, (0, 1)), by_u2, atol=1e-7)
    n = surface.normals(u1, u2)
    np.testing.assert_allclose(np.sum(n * by_u1, 1), 0, atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1, atol=1e-12)
    assert np.all(np.sum(n[:, :2] * surface.at(u1, u2)[:, :2], 1) > 0)  # outward
    np.testing.assert_array_equal(FourierSurface.of(trunk()).low_pass(0).normals(0.1, 0.2), 0)


def test_a_low_pass_is_the_nearest_shape_of_its_order():
    points = random.normal(size=(31, 3))
    curve, u = FourierCurve.of(points), np.arange(31) / 31
    errors = [np.sum((curve.low_pass(n).at(u) - points) ** 2) for n in range(16)]
    assert np.all(np.diff(errors) < 0)
    assert errors[-1] < 1e-20
    waves = np.concatenate([np.cos(2 * np.pi * np.outer(u, range(4))), np.sin(2 * np.pi * np.outer(u, range(1, 4)))], 1)
    least = np.linalg.lstsq(waves, points, rcond=None)[0]
    np.testing.assert_allclose(curve.low_pass(3).at(u), waves @ least, atol=1e-12)
    np.testing.assert_allclose(curve.low_pass(0).at(0.4), points.mean(0), atol=1e-12)
    np.testing.assert_allclose(FourierCurve.of(points, 3).coefficients, curve.low_pass(3).coefficients)


def test_two_ends_do_not_swing():
    """A trunk cut at the same order: its ends are kept far better than when it is taken as a ring."""
    grid = trunk()
    open_ended = FourierSurface.of(grid, closed=(True, False), orders=(8, 8))
    ring = FourierSurface.of(grid, closed=(True, True), orders=(8, 8))
    errors = [np.abs(s.samples(grid.shape[:2]) - grid).max() for s in (open_ended, ring)]
    assert errors[0] < 0.1 * errors[1]


@pytest.mark.parametrize("flipped", [False, True])
@pytest.mark.parametrize("swapped", [False, True])
def test_triangles_close_and_look_outward(flipped, swapped):
    grid = trunk()[::-1] if flipped else trunk()
    grid = grid.swapaxes(0, 1) if swapped else grid
    surface = FourierSurface.of(grid, closed=(not swapped, swapped), orders=(6, 6))
    vertices, faces = surface.triangles((30, 20))
    mesh = MeshSurface(0, vertices, faces)  # raises where it is open, flipped or inside out
    assert len(mesh.faces) == len(faces)
    np.testing.assert_allclose(vertices[:600].reshape(30, 20, 3), surface.samples((30, 20)))
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)
    assert np.all(np.unique(edges, axis=0, return_counts=True)[1] == 2)


def test_a_ring_of_rings_closes():
    a, b = 2 * np.pi * np.arange(12)[:, None] / 12, 2 * np.pi * np.arange(9) / 9
    reach = 1 + 0.3 * np.cos(b)
    torus = np.stack([reach * np.cos(a), reach * np.sin(a), 0.3 * np.sin(b) + 0 * a], -1)
    vertices, faces = FourierSurface.of(torus).triangles((60, 40))
    MeshSurface(0, vertices, faces)
    x = vertices[faces]
    volume = np.sum(x[:, 0] * np.cross(x[:, 1], x[:, 2])) / 6
    assert abs(volume / (2 * np.pi**2 * 0.3**2) - 1) < 0.01


def test_levels_run_from_coarse_to_whole():
    surface, curve = FourierSurface.of(trunk(), closed=(True, False)), FourierCurve.of(random.normal(size=(40, 3)))
    found = [s.orders for s in levels(surface, 4)]
    assert found[0] == (2, 2)
    assert found[-1] == surface.orders
    assert np.all(np.diff(found, axis=0) > 0)
    assert [c.order for c in levels(curve, 3, lowest=5)] == [5, 10, 20]
    assert levels(curve, 1)[0].order == 20
    assert [c.order for c in levels(FourierCurve.of(random.normal(size=(3, 3))), 2)] == [1, 1]


def test_points_are_spread_evenly_along_a_contour():
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 0], [1, 1, 0], [0.9, 1, 0], [0, 1, 0]], float)
    points = by_length(square, 8)
    expected = [[0, 0, 0], [0.5, 0, 0], [1, 0, 0], [1, 0.5, 0], [1, 1, 0], [0.5, 1, 0], [0, 1, 0], [0, 0.5, 0]]
    np.testing.assert_allclose(points, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: FourierCurve.of(np.zeros((2, 3))), "points of shape"),
        (lambda: FourierCurve.of(np.zeros((5, 2))), "points of shape"),
        (lambda: FourierCurve.of(np.full((5, 3), np.nan)), "not finite"),
        (lambda: FourierCurve.of(np.zeros((8, 3)), 5), "order 5 of a series that was sampled for 4"),
        (lambda: FourierCurve.of(np.zeros((8, 3))).low_pass(-1), "order -1"),
        (lambda: FourierSurface.of(np.zeros((8, 3))), "points of shape"),
        (lambda: FourierSurface.of(np.zeros((8, 8, 3)), orders=(3, 5)), "order 5"),
        (lambda: by_length(np.zeros((4, 3)), 9), "a contour of one point"),
    ],
)
def test_bad_input_says_what_is_wrong(make, message):
    with pytest.raises(BodyError, match=message):
        make()


def test_a_body_file_names_a_contour(tmp_path):
    """P1 2.2: a thin plate whose boundary is the curve, from points that are not evenly spaced, in millimetres."""
    u = 2 * np.pi * np.arange(20_000) / 20_000
    ring = np.stack([0.10 * np.cos(u), 0.02 * np.sin(2 * u), -0.06 * np.sin(u)], axis=-1)
    some = np.sort(np.random.default_rng(3).choice(len(ring), 2000, replace=False))
    np.savetxt(tmp_path / "loop.csv", 1e3 * ring[some], delimiter=",")
    text = '[body]\nname = "loop"\n[[segment]]\nname = "loop"\njoint = { name = "free", type = "free" }\n'
    text += 'surface = { contour = "loop.csv", unit = "mm", order = 12, mirror = true }\n'
    (tmp_path / "loop.toml").write_text(text)
    mesh = load_body(tmp_path / "loop.toml").surfaces[0]
    assert mesh.open_edges == 0 and mesh.series.order == 12
    front, back = mesh.vertices.reshape(2, -1, 3)
    np.testing.assert_allclose(np.linalg.norm(front - back, axis=1), 0.001, atol=1e-9)
    middle = 0.5 * (front + back)[:-1]
    away = np.linalg.norm(middle[:, None] - ring * (1.0, 1.0, -1.0), axis=2).min(axis=1)
    assert len(middle) == 256 and away.max() < 0.0005
    (tmp_path / "loop.toml").write_text(text.replace("order = 12", "order = 200"))
    with pytest.raises(BodyError, match="order 200 of a series that was sampled for 128") as caught:
        load_body(tmp_path / "loop.toml")
    assert str(caught.value.file).endswith("loop.csv")


def test_a_body_file_names_a_series(tmp_path):
    u, v = np.meshgrid(np.arange(12) / 12, np.linspace(0, 1, 9), indexing="ij")
    r = 0.05 + 0.02 * np.sin(np.pi * v) + 0.004 * np.cos(6 * np.pi * u)
    grid = np.stack([r * np.cos(2 * np.pi * u), 0.3 * v, -r * np.sin(2 * np.pi * u)], axis=-1)
    np.savetxt(tmp_path / "vase.csv", 1e3 * grid.reshape(-1, 3), delimiter=",")
    text = """[body]
name = "vase"
[[segment]]
name = "vase"
joint = { name = "free", type = "free" }
surface = { fourier = "vase.csv", unit = "mm", grid = [12, 9], closed = [true, false], orders = [2, 4], nodes = [24, 9]}
"""
    (tmp_path / "vase.toml").write_text(text)
    mesh = load_body(tmp_path / "vase.toml").surfaces[0]
    series = FourierSurface.of(grid, closed=(True, False), orders=(2, 4))
    np.testing.assert_allclose(mesh.vertices, series.triangles((24, 9))[0], atol=1e-9)
    (tmp_path / "vase.toml").write_text(text.replace("[12, 9]", "[12, 8]"))
    with pytest.raises(BodyError, match="108 lines of 3 numbers for a grid of 12 x 8"):
        load_body(tmp_path / "vase.toml")
    (tmp_path / "vase.toml").write_text(text.replace("grid = [12, 9], ", ""))
    with pytest.raises(BodyError, match="one shape"):
        load_body(tmp_path / "vase.toml")
