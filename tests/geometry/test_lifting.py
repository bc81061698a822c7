"""A shape of known size before one camera is placed where it is seen."""

import numpy as np
import pytest
from tests.oracle import look_at

from kinefit.geometry.lines import placed

CAMERA = look_at("c", (1.0, 2.0, 4.0), (0.0, 1.0, 0.0))


def shape(count=12):
    """Points in the world, and the same along the camera's axes from somewhere else."""
    x = np.random.default_rng(0).uniform(-0.5, 0.5, (count, 3)) + [0.0, 1.0, 0.0]
    own = x @ CAMERA.T_camera_world[:3, :3].T
    return x, own - own[0] + [3.0, -2.0, 7.0]


def test_it_is_found_where_it_is():
    x, own = shape()
    assert np.allclose(placed(CAMERA, own, CAMERA.project(x)), x, atol=1e-9)


def test_what_is_not_seen_goes_along():
    x, own = shape()
    uv = CAMERA.project(x)
    uv[3:8] = np.nan
    assert np.allclose(placed(CAMERA, own, uv), x, atol=1e-9)
    own[9] = np.nan
    found = placed(CAMERA, own, uv)
    assert np.isnan(found[9]).all() and np.allclose(np.delete(found, 9, axis=0), np.delete(x, 9, axis=0), atol=1e-9)


def test_many_at_once_and_none_where_too_little_is_seen():
    x, own = shape()
    uv = np.stack([CAMERA.project(x), np.full((12, 2), np.nan)])
    uv[1, 0] = uv[0, 0]
    found = placed(CAMERA, np.stack([own, own]), uv)
    assert np.allclose(found[0], x, atol=1e-9) and np.isnan(found[1]).all()


@pytest.mark.parametrize("size", [0.9, 1.2])
def test_a_larger_shape_is_farther_away(size):
    x, own = shape()
    middle, found = x.mean(axis=0), placed(CAMERA, size * own, CAMERA.project(x)).mean(axis=0)
    eye = CAMERA.centre_world
    assert np.linalg.norm(found - eye) == pytest.approx(size * np.linalg.norm(middle - eye), rel=0.01)
