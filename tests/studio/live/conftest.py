"""A simulated person in front of four cameras, as a recording that sessions replay."""

from dataclasses import replace
from functools import cached_property

import numpy as np
import pytest

from kinefit.bodies.motion import UP_AXES
from kinefit.fitting.tracking.recording import Recording
from kinefit.fitting.tracking.tracker import Tracker
from kinefit.geometry import se3
from kinefit.simulation import cut, simulate_keypoints, squat_and_wave, studio_rig
from kinefit.studio.live.folders import Replay

FRAMES = 30


class Scene:
    """What the tests replay, with truth."""

    def __init__(self):
        self.motion = cut(squat_and_wave(), 0, FRAMES)
        self.rig = studio_rig(self.motion)
        self.keypoints = simulate_keypoints(self.motion, self.rig, "BODY_25B")
        self.recording = Recording(self.motion.times, self.motion.rate, self.rig, up=self.motion.up)

    def tracker(self):
        return Tracker(self.motion.body, self.rig, rate=self.motion.rate, up=UP_AXES[self.motion.up])

    def replay(self, speed=0.0):
        return Replay(self.recording, self.keypoints, speed=speed)

    @cached_property
    def two(self):
        """Keypoints of the person, the second in every record, and of one in the same pose a metre beside."""
        other = replace(self.motion, Ts_world_root=self.aside @ self.motion.Ts_world_root)
        return [
            replace(k, points=np.concatenate([o.points, k.points], axis=1),
                    confidence=np.concatenate([o.confidence, k.confidence], axis=1))
            for k, o in zip(self.keypoints, simulate_keypoints(other, self.rig, "BODY_25B"))
        ]  # fmt: skip

    @property
    def aside(self):
        """(4, 4) from the person to the other one: a metre along a level axis."""
        return se3.transform(np.eye(3), -np.roll(UP_AXES[self.motion.up], 1))


@pytest.fixture(scope="session")
def scene():
    return Scene()


class Collected:
    """A receiver that keeps what it gets."""

    def __init__(self):
        self.hellos, self.poses, self.packets, self.closed = [], [], [], False

    def hello(self, body, packet):
        self.hellos.append(packet)

    def pose(self, posed, packet):
        self.poses.append(posed)
        self.packets.append(packet)

    def close(self):
        self.closed = True


@pytest.fixture
def collected():
    return Collected()
