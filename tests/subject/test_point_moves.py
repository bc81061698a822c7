"""Derivatives of points by lengths and places are those of rows in other worlds."""

import numpy as np
import pytest
from tests.oracle import posture, rig_around

from kinefit.bodies import load_body
from kinefit.losses import SQUARED
from kinefit.observations import KeypointFrame
from kinefit.sensors.keypoints import KeypointSensor
from kinefit.sensors.scene import Scene
from kinefit.solvers.border_frames import differences
from kinefit.subject.matched_frames import MatchedFrames, Worlds
from kinefit.subject.parameters import PointOffsets, SegmentScales, World, stacked

BODY = load_body("humanoid")


class Slow:
    """The same problem by the rows of other worlds alone."""

    def __init__(self, problem):
        self.problem, self.body, self.parts = problem, problem.body, problem.parts


@pytest.mark.parametrize("seed", range(3))
def test_they_are_those_of_rows_in_other_worlds(seed):
    rig, states = rig_around((0.0, 0.0, 0.0), cameras=3), [posture(BODY, 3 + seed, 0.3)]
    parameters = [SegmentScales(BODY), PointOffsets(BODY, "COCO_17", 0.01)]
    points = BODY.keypoints("COCO_17")
    x = BODY.positions(states[0], points)
    frames = [
        KeypointFrame(c.name, 0.0, points.names, c.project(x) + 2.0, np.ones(len(x)), "COCO_17") for c in rig
    ]
    steps = [[KeypointSensor(rig, {}, 2.0, SQUARED, 0.1).prepare(frames, Scene(BODY, states[0], rig))]]
    _, mean, _, step = stacked(parameters)
    theta = mean + np.random.default_rng(seed).normal(scale=0.02, size=len(mean))
    problem = MatchedFrames(Worlds(World(BODY, rig), parameters), steps, None, None, theta, states, 0.1)
    quick, slow = differences(problem, theta, step, states)[0], differences(Slow(problem), theta, step, states)[0]
    assert not np.isnan(problem.columns(theta, step, states)[0]).any()
    assert np.abs(slow[:, 0]).max() > 1.0
    np.testing.assert_allclose(quick, slow, atol=1e-4)
