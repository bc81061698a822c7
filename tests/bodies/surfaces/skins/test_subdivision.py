"""Surfaces over nets of quadrilaterals: B-splines where they are regular, closed and smooth everywhere."""

import numpy as np
import pytest

from kinefit.bodies.surfaces.skins.skinning import check_closed, interpolated, limit, spread, subdivided
from kinefit.errors import BodyError

CUBE = np.array([[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]])
CORNERS = np.array([[x, y, z] for z in (-1, 1) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))], float)


def torus(rows=8, columns=10):
    """A regular net: four faces at every corner."""
    number = np.arange(rows * columns).reshape(rows, columns)
    right, below = np.roll(number, -1, axis=1), np.roll(number, -1, axis=0)
    faces = np.stack([number, right, np.roll(below, -1, axis=1), below], axis=-1).reshape(-1, 4)
    return np.random.default_rng(3).normal(size=(rows * columns, 3)), faces


def test_a_regular_net_becomes_the_bicubic_b_spline():
    control, faces = torus()
    grid = control.reshape(8, 10, 3)
    sixth, half = np.array([1, 4, 1]) / 6, np.array([1, 23, 23, 1]) / 48

    def spline(weights, axis, values):
        return sum(w * np.roll(values, 1 - k, axis=axis) for k, w in enumerate(weights))

    at = limit(control, faces).reshape(8, 10, 3)
    assert at == pytest.approx(spline(sixth, 0, spline(sixth, 1, grid)))
    finer, quads = subdivided(control, faces)
    ends = limit(finer, quads)
    assert ends[:80].reshape(8, 10, 3) == pytest.approx(at)  # refining changes nothing of where a corner ends up
    middles = ends[80:160].reshape(8, 10, 3)
    assert middles == pytest.approx(spline(half, 0, spline(half, 1, grid)))


def test_it_stays_closed_and_its_edges_get_flat_where_three_faces_meet():
    x, faces, bends = CORNERS, CUBE, []
    for _ in range(5):
        x, faces = subdivided(x, faces)
        check_closed(faces)
        at = limit(x, faces)[faces]
        normal = np.cross(at[:, 2] - at[:, 0], at[:, 3] - at[:, 1])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        edges = {tuple(e): q for k in range(4) for q, e in enumerate(faces[:, [k, (k + 1) % 4]].tolist())}
        pairs = np.array([(q, edges[b, a]) for (a, b), q in edges.items()])
        cos = (normal[pairs[:, 0]] * normal[pairs[:, 1]]).sum(axis=1)
        bends.append(np.degrees(np.arccos(np.clip(cos, -1, 1)).max()))
    assert len(x) == 6 * 4**5 + 2
    assert (np.array(bends[1:]) < 0.6 * np.array(bends[:-1])).all() and bends[-1] < 4


def test_limits_can_be_where_they_are_wanted():
    control, faces = subdivided(*subdivided(CORNERS, CUBE))
    assert limit(interpolated(control, faces, rounds=12), faces) == pytest.approx(control, abs=1e-3)


def test_what_spreads_keeps_its_sum_of_shares():
    weights = np.eye(8)[:, :2] + np.eye(8)[:, 2:4]
    weights = np.column_stack([weights, 1 - weights.sum(axis=1)])
    out = spread(weights, CUBE, 3)
    assert out.sum(axis=1) == pytest.approx(1) and out.min() >= 0 and np.ptp(out[:, 0]) < np.ptp(weights[:, 0])


def test_an_open_or_turned_net_is_refused():
    with pytest.raises(BodyError, match="4 edges have no twin"):
        check_closed(CUBE[:-1])
    turned = CUBE.copy()
    turned[0] = turned[0, ::-1]
    with pytest.raises(BodyError, match="not closed"):
        check_closed(turned)
