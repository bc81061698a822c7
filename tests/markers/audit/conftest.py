"""A simulated person whose markers are labelled."""

import numpy as np
import pytest

from kinefit.bodies.marker_sets import placement
from kinefit.observations import Markers
from kinefit.simulation import squat_and_wave


@pytest.fixture(scope="package")
def waving():
    """Four seconds of 41 markers with 1 mm of noise: arms wave, knees bend, the feet stand."""
    truth = squat_and_wave(rate=60.0, duration=4.0)
    points, rng = placement(truth.body, "CMU_41").points, np.random.default_rng(0)
    x = truth.positions(points)
    return Markers(points.names, truth.rate, x + rng.normal(0.0, 0.001, x.shape), up=truth.up)
