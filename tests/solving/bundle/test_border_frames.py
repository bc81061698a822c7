"""Poses that settle by themselves: of pixels alone in one kernel, of anything else step by step."""

import numpy as np
import pytest

from kinefit.fitting.subject.fit import MatchedFrames, Worlds
from kinefit.fitting.subject.parameters import SegmentScales, World
from kinefit.geometry.losses import geman_mcclure
from kinefit.sensors.channels import make_channels
from kinefit.sensors.points.keypoints import KeypointMeasurement, KeypointSensor, Layout
from kinefit.simulation import cut, simulate_keypoints, squat_and_wave, studio_rig
from kinefit.solving.bundle.border_frames import Weighing, frame_at, settle


class Unpacked:
    """The same problem by its rows alone."""

    def __init__(self, frames):
        self.body, self.parts = frames.body, frames.parts


@pytest.fixture(scope="module")
def frames():
    motion = cut(squat_and_wave(), 0, 4)
    rig, body = studio_rig(motion), motion.body
    records = simulate_keypoints(motion, rig, "BODY_25B", noise_px=2.0)
    channels = make_channels(body, rig, records, np.full(len(rig), 4.0))
    sensor, layout = KeypointSensor(rig, {}, 0.0, geman_mcclure(), 0.03), Layout(channels, body)
    sure = channels.weight * 16
    steps = [[KeypointMeasurement(sensor, layout, uv, w, 0.0)] for uv, w in zip(channels.uv, sure)]
    rng, states = np.random.default_rng(2), []
    for k in range(len(motion)):
        states.append(motion.state(k).retract(0.03 * rng.standard_normal(body.tree.n_dofs)))
    lengths = SegmentScales(body)
    theta = np.zeros(len(lengths.names))
    return MatchedFrames(Worlds(World(body, rig), [lengths]), steps, None, None, theta, states, 0.03), theta, states


def test_poses_settle_in_one_kernel_as_by_their_rows(frames):
    problem, theta, states = frames
    weighing = Weighing(posture=0.1)
    assert all(problem.packed(theta, f, state) is not None for f, state in enumerate(states))
    fast, slow = (settle(p, theta, states, weighing, 40) for p in (problem, Unpacked(problem)))
    for f, (a, b, state) in enumerate(zip(fast[0], slow[0], states)):
        assert a.cost == pytest.approx(b.cost, rel=1e-4) and a.cost < frame_at(problem, theta, f, state, weighing).cost
        there = frame_at(problem, theta, f, fast[1][f], weighing)
        np.testing.assert_allclose(a.H, there.H, atol=1e-8 * np.abs(a.H).max())
        np.testing.assert_allclose(a.g, there.g, atol=1e-8 * np.abs(a.H).max())
        assert a.cost == pytest.approx(there.cost)


def test_a_sensor_that_counts_for_less_settles_by_its_rows(frames):
    problem, theta, states = frames
    less = Weighing({"keypoints": 0.25}, posture=0.1)
    fast, slow = (settle(p, theta, states, less) for p in (problem, Unpacked(problem)))
    assert [a.cost for a in fast[0]] == [b.cost for b in slow[0]]
