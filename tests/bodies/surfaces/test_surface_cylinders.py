"""Tapered elliptical cylinders: closest points against scipy, samples and closed forms; boxes; what is refused."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from tests.oracle import random_unit

from kinefit.bodies import BodyState, TaperedCylinder, load_body
from kinefit.bodies.surfaces import bounding_box
from kinefit.bodies.surfaces.closest._kernels_cylinder import nearest_on_cylinders, nearest_on_cylinders_exact
from kinefit.bodies.surfaces.places import nearest
from kinefit.bodies.surfaces.tables import tables
from kinefit.errors import BodyError, KinefitError, ObservationError
from kinefit.geometry import se3

radius = st.floats(0.02, 0.2)
numbers = st.builds(
    # a radius changes by less than the length: beyond that, one point of thousands finds another local minimum
    lambda length, a0, b0, a1, b1, seed: (length, ((a0, b0), (a1, b1)), seed),
    st.floats(0.2, 0.6), radius, radius, radius, radius, st.integers(0, 10**6),
)  # fmt: skip


def cylinder_of(length, radii, seed):
    random = np.random.default_rng(seed)
    start, axis, side = random.normal(scale=0.2, size=3), random_unit(random), random.normal(size=3)
    return TaperedCylinder(0, start, start + length * axis, radii, side)


def search(cylinders, x, kernel=nearest_on_cylinders_exact, bound=10.0, only=None):
    """Signed distance (N,), normal (N, 3) and segment (N,) of points (N, 3) in the segment's frame."""
    n, segments = len(x), 1 + max(c.segment for c in cylinders)
    frames = np.tile(np.r_[np.eye(3).ravel(), np.zeros(3)], (segments, 1))
    best, normal, segment = np.full(n, bound), np.zeros((3, n)), np.full(n, -1)
    table = tables(cylinders, np.zeros((segments, 3))).cylinders
    wanted = np.full(n, -1) if only is None else only
    kernel(np.ascontiguousarray(x.T), frames, table, wanted, best, normal, segment)
    return best, normal.T, segment


def around(c, count, seed, reach=0.3):
    """Points (N, 3) in the segment's frame about a cylinder, inside and outside."""
    box = bounding_box(c, reach)
    return box.centre + np.random.default_rng(seed).uniform(-1, 1, (count, 3)) * box.half @ box.axes


def local(c, x):
    """Coordinates (N, 3) along the half axes and the axis."""
    return (np.asarray(x) - c.start) @ c.axes.T


def section(c, h):
    """Half axes (N, 2) at heights (N,) [m]."""
    t = (np.asarray(h) / c.length)[:, None]
    return (1 - t) * c.radii[0] + t * np.array(c.radii[1])


def sampled(c, around_=180, along=60):
    """Dense points (K, 3) of the whole surface, in the segment's frame."""
    angle, t = np.meshgrid(np.linspace(0, 2 * np.pi, around_), np.linspace(0, 1, along), indexing="ij")
    ring = np.stack([np.cos(angle.ravel()), np.sin(angle.ravel())], 1)
    side = np.c_[section(c, t.ravel() * c.length) * ring, t.ravel() * c.length]
    caps = [np.c_[np.sqrt(t.ravel())[:, None] * ring * r, np.full(t.size, h)] for r, h in zip(c.radii, (0.0, c.length))]
    return np.concatenate([side, *caps]) @ c.axes + c.start


def is_inside(c, x):
    q = local(c, x)
    shape = section(c, np.clip(q[:, 2], 0, c.length))
    return (q[:, 2] > 0) & (q[:, 2] < c.length) & (np.sum((q[:, :2] / shape) ** 2, axis=1) < 1)


@given(numbers)
@settings(max_examples=60, deadline=None)
def test_the_closest_point_lies_on_the_surface_and_no_other_is_nearer(shape):
    c = cylinder_of(*shape)
    x = around(c, 40, shape[2])
    d, n, _ = search([c], x)
    q = local(c, x - d[:, None] * n)
    out = np.sum((q[:, :2] / section(c, np.clip(q[:, 2], 0, c.length))) ** 2, axis=1) - 1
    on_side = (np.abs(out) < 1e-6) & (q[:, 2] > -1e-8) & (q[:, 2] < c.length + 1e-8)
    on_cap = (out < 1e-6) & ((np.abs(q[:, 2]) < 1e-8) | (np.abs(q[:, 2] - c.length) < 1e-8))
    assert np.all(on_side | on_cap)
    assert np.linalg.norm(n, axis=1) == pytest.approx(1, abs=1e-9)
    samples = sampled(c)
    rival = np.linalg.norm(samples[None] - x[:, None], axis=2).min(axis=1)
    assert np.all(np.abs(d) <= rival + 1e-9)
    np.testing.assert_array_equal(d < 0, is_inside(c, x))


@pytest.mark.parametrize("seed", range(6))
def test_the_exact_kernel_agrees_with_a_general_minimiser(seed):
    random = np.random.default_rng(seed)
    c = cylinder_of(random.uniform(0.1, 0.5), random.uniform(0.02, 0.2, (2, 2)), seed)
    samples, x = sampled(c, 60, 20)[: 60 * 20], around(c, 25, seed)
    d, _, _ = search([c], x)
    shape = np.array(c.radii)

    def point(v):
        return np.r_[((1 - v[1]) * shape[0] + v[1] * shape[1]) * (np.cos(v[0]), np.sin(v[0])), v[1] * c.length]

    grid = np.meshgrid(np.linspace(0, 2 * np.pi, 60), np.linspace(0, 1, 20), indexing="ij")
    starts = np.stack(grid, axis=-1).reshape(-1, 2)
    for i, q in enumerate(local(c, x)):
        first = starts[np.argmin(np.linalg.norm(samples - x[i], axis=1))]
        found = minimize(
            lambda v, q=q: np.sum((point(v) - q) ** 2), first, method="L-BFGS-B", bounds=[(None, None), (0, 1)],
            options={"ftol": 1e-16, "gtol": 1e-12},
        )  # fmt: skip
        others = [abs(q[2] - h) for r, h in zip(shape, (0, c.length)) if np.sum((q[:2] / r) ** 2) < 1]
        assert abs(d[i]) == pytest.approx(min([np.sqrt(found.fun), *others]), abs=1e-7)  # [m]: 1e-4 mm


@given(numbers)
@settings(max_examples=40, deadline=None)
def test_round_sections_have_a_closed_form(shape):
    """In the half plane of axis and radius the cylinder is a trapezium: distance to three line segments."""
    length, ((r0, _), (r1, _)), seed = shape
    c = cylinder_of(length, ((r0, r0), (r1, r1)), seed)
    x = around(c, 30, seed)
    q = local(c, x)
    flat = np.c_[np.hypot(q[:, 0], q[:, 1]), q[:, 2]]
    corners = np.array([[0, 0], [r0, 0], [r1, length], [0, length]])
    expected = np.full(len(x), np.inf)
    for a, b in pairwise(corners):
        t = np.clip((flat - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
        expected = np.minimum(expected, np.linalg.norm(flat - a - t[:, None] * (b - a), axis=1))
    for kernel in (nearest_on_cylinders_exact, nearest_on_cylinders):
        d, _, _ = search([c], x, kernel)
        np.testing.assert_allclose(np.abs(d), expected, atol=1e-7 if kernel is nearest_on_cylinders_exact else 1e-4)


def test_the_fast_kernel_is_near_the_exact_one_on_a_body():
    body = load_body("humanoid")
    for c in body.surfaces:
        c = replace(c, segment=0)
        x = around(c, 2000, 1, reach=0.1)
        exact, n_exact, _ = search([c], x)
        fast, n_fast, _ = search([c], x, nearest_on_cylinders)
        error = np.abs(fast - exact)
        close = np.abs(exact) < 0.03
        assert np.percentile(error[close], 95) < 2e-4 and error[close].max() < 3e-3, c
        turned = np.sum(n_exact * n_fast, axis=1)[close & (exact > 0.002)]
        assert np.degrees(np.arccos(np.clip(np.median(turned), -1, 1))) < 0.5, c


def test_points_on_surface_centre_axis_and_edge_have_a_normal():
    c = TaperedCylinder(0, (0, 0, 0), (0, 0.4, 0), ((0.1, 0.06), (0.05, 0.08)))
    at = [[0.1, 0, 0], [0, 0.2, 0], [0.075, 0.2, 0], [0, 0.4, 0], [0, 0.4, 0.08], [0, 0.2, 0.01], [0.01, 0.2, 0]]
    x = np.array(at)
    for kernel in (nearest_on_cylinders_exact, nearest_on_cylinders):
        d, n, segment = search([c], x, kernel)
        assert np.isfinite(d).all() and np.all(segment == 0)
        assert np.linalg.norm(n, axis=1) == pytest.approx(1, abs=1e-5)
        assert d[[0, 2, 3, 4]] == pytest.approx(0, abs=1e-6)
        assert d[1] == pytest.approx(-0.07, abs=2e-3) and n[3] == pytest.approx([0, 1, 0])


def test_only_the_wanted_segment_and_nothing_beyond_the_bound():
    low = TaperedCylinder.round(0, (0, 0.2, 0), (0.05, 0.05))
    high = TaperedCylinder.round(1, (0, 0.6, 0), (0.05, 0.05), start=(0, 0.4, 0))
    x = np.array([[0.06, 0.1, 0], [0.06, 0.5, 0], [0.3, 0.1, 0]])
    for kernel in (nearest_on_cylinders_exact, nearest_on_cylinders):
        assert search([low, high], x, kernel, 0.1)[2].tolist() == [0, 1, -1]
        d, n, segment = search([low, high], x, kernel, 0.35, only=np.array([1, 1, -1]))
        assert segment.tolist() == [1, 1, 0] and d == pytest.approx([np.hypot(0.01, 0.3), 0.01, 0.25], abs=1e-6)
        assert n[0] == pytest.approx(np.array([0.01, -0.3, 0]) / np.hypot(0.01, 0.3), abs=1e-5)


@pytest.mark.parametrize("count", [0, 1, 1023, 1024, 1025, 3000])
def test_the_result_does_not_depend_on_the_blocks(count):
    c = cylinder_of(0.3, ((0.1, 0.05), (0.06, 0.08)), 3)
    x = around(c, 3000, 0)
    for kernel in (nearest_on_cylinders_exact, nearest_on_cylinders):
        whole, part = search([c], x, kernel), search([c], x[:count], kernel)
        for a, b in zip(whole, part):
            np.testing.assert_allclose(a[:count], b, atol=1e-5)  # the last few points are no vector code


def test_nearest_moves_with_the_body():
    body, random = load_body("humanoid10"), np.random.default_rng(2)
    state = body.default_state()
    x = body.positions(state, body.landmarks) + random.normal(scale=0.03, size=(len(body.landmarks), 3))
    T = se3.exp(random.normal(size=6))
    here = nearest(body, state, x, max_distance=0.2, exact=True)
    there = nearest(
        body, BodyState(T @ state.T_world_root, state.angles), se3.apply(T, x), max_distance=0.2, exact=True
    )
    np.testing.assert_allclose(there.distance, here.distance, atol=1e-9)
    np.testing.assert_allclose(there.point, se3.apply(T, here.point), atol=1e-7)
    np.testing.assert_allclose(there.normal, here.normal @ T[:3, :3].T, atol=1e-6)
    np.testing.assert_array_equal(there.segment, here.segment)
    assert (here.segment >= 0).mean() > 0.9
    alone = nearest(body, state, x, max_distance=5.0, only=2)
    assert set(alone.segment) == {2}


def test_nearest_of_wrong_points_is_told():
    body = load_body("arm")
    state = body.default_state()
    for x, options in (
        (np.zeros((3, 2)), {}), ([[np.nan, 0, 0]], {}), (np.zeros((2, 3)), {"max_distance": 0.0}),
        (np.zeros((2, 3)), {"only": [0, 9]}), (np.zeros((2, 3)), {"only": [0.5, 1.0]}),
    ):  # fmt: skip
        with pytest.raises(ObservationError):
            nearest(body, state, x, **({"max_distance": 0.1} | options))
    found = nearest(body, state, np.zeros((0, 3)), max_distance=0.1)
    assert found.point.shape == (0, 3) and len(found.segment) == 0


@given(numbers, st.floats(1e-6, 0.1))
@settings(max_examples=20, deadline=None)
def test_the_box_holds_all_of_the_surface_and_touches_it(shape, margin):
    c = cylinder_of(*shape)
    box = bounding_box(c, margin)
    samples = sampled(c)
    assert box.contains(samples).all()
    np.testing.assert_allclose(np.abs((samples - box.centre) @ box.axes.T).max(axis=0), box.half - margin, rtol=1e-3)


def test_axes_are_right_handed_and_the_side_is_made_perpendicular():
    c = TaperedCylinder(0, (0, 0, 0), (0, 0, 2.0), ((1, 2), (3, 4)), (3.0, 0.0, 5.0))
    np.testing.assert_allclose(c.axes, [[1, 0, 0], [0, 1, 0], [0, 0, 1]], atol=1e-15)
    assert replace(c) == c and np.linalg.det(cylinder_of(0.3, ((0.1, 0.2), (0.1, 0.2)), 0).axes) == pytest.approx(1)
    assert c.scaled(0.5).radii == ((0.5, 1.0), (1.5, 2.0)) and c.scaled(0.5).length == 1.0
    assert TaperedCylinder.round(0, (1, 0, 0), (1, 1)).side == (0.0, 1.0, 0.0)


@pytest.mark.parametrize(
    "wrong",
    [
        {"end": (0, 0, 0)}, {"radii": ((0.1, 0.0), (0.1, 0.1))}, {"radii": ((0.1, -1), (0.1, 0.1))},
        {"radii": (0.1, 0.1)},
        {"side": (0, 1, 0)}, {"side": (0, 0, 0)}, {"side": (np.nan, 0, 0)}, {"end": (0, np.inf, 0)},
        {"radii": ((0.1, np.nan), (0.1, 0.1))},
    ],
)  # fmt: skip
def test_a_cylinder_that_cannot_be_is_refused(wrong):
    good = {"start": (0, 0, 0), "end": (0, 0.3, 0), "radii": ((0.1, 0.1), (0.1, 0.1)), "side": (1, 0, 0)}
    TaperedCylinder(0, **good)
    with pytest.raises(BodyError) as error:
        TaperedCylinder(0, **(good | wrong))
    assert isinstance(error.value, KinefitError) and error.value.remedy
