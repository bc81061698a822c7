"""The recipe that users should take, on a simulated sensor: size and start found, tracked within centimetres."""

import numpy as np
import pytest

from kinefit.bodies import load_body
from kinefit.errors import ObservationError, TrackingError
from kinefit.papers.depth_fusion import depth_fusion
from kinefit.simulation.evaluation.sequences import sequence
from kinefit.simulation.evaluation.voodoo import point_errors
from kinefit.simulation.movements import people
from kinefit.simulation.rendering.sensors import TOF


@pytest.fixture(scope="module")
def wave():
    return sequence("wave", people()[2], sensor=TOF)


def test_from_a_known_start(wave):
    motion = depth_fusion(
        wave.seen("fusion"), wave.truth.body, wave.rig, rate=10.0, sigma=wave.sigma, up=wave.truth.up,
        start=wave.truth.state(0),
    )  # fmt: skip
    assert len(motion) == len(wave.truth)
    assert point_errors(wave.truth, motion).mean() < 0.04
    assert motion.residuals["colour"].unit == "px"
    assert np.isfinite(motion.joint_std).all() and (motion.quality > 0.5).all()
    assert motion.provenance["frames"] == {"dropped": 0, "late": 0}


def test_a_step_without_frames_is_bridged(wave):
    steps = [list(seen) for seen in wave.seen("3d")[:6]]
    steps[3] = []
    motion = depth_fusion(
        steps, wave.truth.body, wave.rig, rate=10.0, sigma=wave.sigma, start=wave.truth.state(0)
    )
    assert len(motion) == 6 and motion.quality[3] == 0.0 and motion.quality[4] > 0.5
    np.testing.assert_allclose(np.diff(motion.times), 0.1, atol=1e-9)


@pytest.mark.slow
def test_with_nothing_given(wave):
    motion = depth_fusion(
        wave.seen("fusion")[:12], load_body("humanoid10"), wave.rig, rate=10.0, sigma=wave.sigma,
        up=wave.truth.up,
    )  # fmt: skip
    errors = np.linalg.norm(
        motion.positions(motion.body.landmarks.select(("neck", "l_knee", "r_knee")))
        - wave.truth.positions(wave.truth.body.landmarks.select(("neck", "l_knee", "r_knee")))[:12],
        axis=-1,
    )
    assert np.median(errors) < 0.08


def test_nothing_seen_is_refused(wave):
    with pytest.raises(ObservationError, match="no step has a frame"):
        depth_fusion([[], []], wave.truth.body, wave.rig, rate=10.0)
    with pytest.raises(TrackingError, match="not found in the first"):
        nobody = [[type(seen[0])("depth", seen[0].time, np.zeros_like(seen[0].depth))] for seen in wave.seen("3d")[:3]]
        depth_fusion(nobody, wave.truth.body, wave.rig, rate=10.0, size=False)
