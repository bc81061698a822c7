"""Derivatives of points by lengths and places are those of rows in other worlds."""

import numpy as np
import pytest
from tests.oracle import posture, rig_around

from kinefit.bodies import load_body
from kinefit.fitting.subject.fit import MatchedFrames, Worlds
from kinefit.fitting.subject.parameters import PointOffsets, SegmentScales, World, stacked
from kinefit.geometry.losses import SQUARED
from kinefit.observations import KeypointFrame
from kinefit.sensors.points.keypoints import KeypointSensor
from kinefit.sensors.scene import Scene
from kinefit.solving.bundle.border_frames import differences

BODY = load_body("humanoid")


class Slow:
    """The same problem by the rows of other worlds alone."""

    def __init__(self, problem):
        self.problem, self.body, self.parts = problem, problem.body, problem.parts


class Untold:
    """The same parameters, which do not tell how points move with them."""

    of_points = True

    def __init__(self, one):
        self.names, self.mean, self.information, self.step = one.names, one.mean, one.information, one.step
        self.touches, self.apply = one.touches, one.apply


@pytest.mark.parametrize("kind", [lambda one: one, Untold])
@pytest.mark.parametrize("seed", range(3))
def test_they_are_those_of_rows_in_other_worlds(seed, kind):
    rig, states = rig_around((0.0, 0.0, 0.0), cameras=3), [posture(BODY, 3 + seed, 0.3)]
    parameters = [kind(SegmentScales(BODY)), kind(PointOffsets(BODY, "COCO_17", 0.01))]
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


def test_lengths_carry_places_along():
    told = [PointOffsets(BODY, "COCO_17", 0.01), SegmentScales(BODY)]  # shifted first, then stretched
    theta = np.random.default_rng(0).normal(scale=0.05, size=sum(len(one.names) for one in told))
    step, moved = np.full(len(theta), 1e-4), []
    places = [("COCO_17", name) for name in BODY.keypoints("COCO_17").names]
    for parameters in (told, [Untold(one) for one in told]):
        worlds = Worlds(World(BODY, rig_around((0.0, 0.0, 0.0))), parameters)
        moved.append(worlds.moves(theta, step, np.arange(len(theta)))._of(places))
    np.testing.assert_allclose(moved[0], moved[1], atol=1e-7)
