"""A depth camera alone of which a fifth of the pixels lie anywhere, in a room that was seen empty before."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from tests.fitting.tracking.movements import BODY, RATE, SENSOR, a_motion, a_rig, images

from kinefit import track
from kinefit.fitting.tracking.recording import Recording
from kinefit.observations import DepthFrame
from kinefit.simulation.rendering.scenes import SimulatedScene
from kinefit.simulation.rendering.sensors import measured_depth

FRAMES, WRONG = 10, 0.2


@cache
def empty():
    """(H, W) [m] the room without the person."""
    motion, camera = a_motion(), a_rig()["depth"]
    room = SimulatedScene.of(motion, camera).room
    T = np.array(motion.Ts_world_root)
    T[:, 1, 3] -= 50.0  # far below
    scene = replace(SimulatedScene.of(replace(motion, Ts_world_root=T)), room=room)
    return measured_depth(scene, 0, camera, SENSOR, np.random.default_rng(0))


def recording():
    random, shown = np.random.default_rng(20), []
    for image in images(count=FRAMES):
        wrong = random.random(image.shape) < WRONG
        shown.append(np.where(wrong, random.uniform(0.5, 5.5, image.shape), image).astype(np.float32))
    frames = [DepthFrame("depth", i / RATE, image) for i, image in enumerate(shown)]
    return Recording(
        np.arange(FRAMES) / RATE, RATE, a_rig(), steps=lambda i: [frames[i]], sigma={"depth": 0.01},
        depth={i: frames[i] for i in (0, 9)}, backgrounds={"depth": empty()}, up=a_motion().up,
    )  # fmt: skip


@pytest.mark.slow
def test_the_person_is_found_sized_and_followed_within_the_error_bars():
    motion, truth = track(recording(), BODY), a_motion()
    shift = motion.segment_poses()[:, :, :3, 3] - truth.segment_poses()[:FRAMES, :, :3, 3]
    error, known = np.linalg.norm(shift, axis=-1), np.isfinite(motion.joint_std)
    assert error.mean() < 0.08  # 0.045 to 0.068 on processors that round otherwise: one rounding chooses other pixels
    assert known.mean() > 0.8
    assert np.mean(np.abs(shift[known]) < 1.96 * motion.joint_std[known]) > 0.8  # 0.83 and more
    sure = np.sqrt(np.mean(np.square(motion.joint_std), axis=-1)) < 0.05
    assert np.mean((error > 0.15) & sure) < 0.01
