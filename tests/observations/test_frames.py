"""What a sensor saw at one time: cleaned once, never changed, refused where it cannot be meant."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from kinefit.errors import ObservationError
from kinefit.observations import DepthFrame, PointCloud

DEPTHS = st.sampled_from((0.0, -0.0, 0.3, 2.5, 99.0, -1.0, np.nan, np.inf, -np.inf))


@given(arrays(np.float32, array_shapes(min_dims=2, max_dims=2, max_side=40), elements=DEPTHS))
def test_what_is_no_depth_is_nothing(depth):
    before = depth.copy()
    frame = DepthFrame("tof", 0.0, depth)
    good = np.isfinite(depth) & (depth > 0)
    assert np.array_equal(frame.depth, np.where(good, depth, 0.0)) and frame.depth.dtype == np.float32
    assert frame.size == depth.shape[::-1] and not frame.depth.flags.writeable
    assert np.array_equal(depth, before, equal_nan=True) and not np.shares_memory(depth, frame.depth)


@pytest.mark.parametrize("size", [(480, 640), (24, 32), (1, 1), (17, 3)])
@pytest.mark.parametrize("holes", [0.0, 0.7])
@pytest.mark.parametrize("kind", [np.uint16, float])
def test_millimetres_are_told(size, holes, kind):
    rng = np.random.default_rng(size)
    metres = rng.uniform(0.4, 8.0, size)
    metres[(rng.random(size) < holes) & (np.arange(metres.size).reshape(size) > 0)] = 0.0
    assert np.array_equal(DepthFrame("tof", 0.0, metres).depth, metres.astype(np.float32))
    with pytest.raises(ObservationError, match="probably millimetres"):
        DepthFrame("tof", 0.0, (1000.0 * metres).astype(kind))


def test_a_few_wild_measurements_are_no_millimetres():
    depth = np.full((48, 64), 2.0)
    depth[::5, ::3] = 65535.0
    assert DepthFrame("tof", 0.0, depth).depth.max() == 65535.0


@pytest.mark.parametrize("shape", [(0, 4), (4,), (2, 3, 1), ()])
def test_what_is_no_image_is_told(shape):
    with pytest.raises(ObservationError, match="shape"):
        DepthFrame("tof", 0.0, np.ones(shape))


def test_a_cloud_leaves_out_what_is_not_finite():
    x = np.array([[0.0, 1, 2], [np.nan, 0, 0], [0, np.inf, 0], [3, 4, 5]])
    cloud = PointCloud("scan", 0.0, x, viewpoint=[0, 1, 2])
    assert np.array_equal(cloud.points, x[[0, 3]]) and len(cloud) == 2
    assert cloud.viewpoint.dtype == float and not cloud.viewpoint.flags.writeable


@pytest.mark.parametrize("viewpoint", [(0, 1), (0, 1, np.nan), (0, 1, np.inf), [[0, 1, 2]]])
def test_a_viewpoint_that_is_no_place_is_told(viewpoint):
    with pytest.raises(ObservationError, match="viewpoint"):
        PointCloud("scan", 0.0, np.zeros((2, 3)), viewpoint=viewpoint)
