"""Medians and distances are those of numpy."""

import numpy as np
from tests.oracle import rig_around

from kinefit.fitting.multiview.association import distances, medians


def test_medians_are_those_of_what_is_finite():
    values = np.random.default_rng(0).normal(size=(40, 3, 7))
    values[np.random.default_rng(1).random(values.shape) < 0.3] = np.nan
    values[0, 0], values[1, 1, 0] = np.nan, np.inf
    told = medians(values)
    assert np.isnan(told[0, 0])
    values[1, 1, 0] = np.nan
    known = np.isfinite(values).any(axis=-1)
    np.testing.assert_allclose(told[known], np.nanmedian(values[known], axis=-1))


def test_distances_are_medians_over_heights():
    random = np.random.default_rng(2)
    camera = rig_around((0.0, 0.0, 0.0)).cameras[1]
    x = random.normal(scale=0.5, size=(3, 9, 3))
    uv = camera.project(x[:2]) + random.normal(scale=5.0, size=(2, 9, 2))
    uv[0, 4], x[1, 2], uv[1, 3:] = np.nan, np.nan, np.nan
    x[0, 0] = 3.0 * camera.centre_world - 2.0 * x[0, 0]  # behind the camera
    told = distances(camera, x, uv)
    for t, points in enumerate(x):
        for p, seen in enumerate(uv):
            both = np.isfinite(points).all(axis=1) & np.isfinite(seen).all(axis=1)
            if both.sum() < 3:
                assert told[t, p] == np.inf
                continue
            away = np.linalg.norm(camera.project(points[both]) - seen[both], axis=1)
            median = np.median(np.where(np.isfinite(away), away, 1e6))
            assert np.isclose(told[t, p], median / np.ptp(seen[both, 1]))
    assert told[1, 1] == np.inf and np.isfinite(told[:, 0]).all()
