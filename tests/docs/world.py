"""What pages take for granted, made once: a person, cameras, and what sensors saw of them."""

from dataclasses import replace
from functools import cache, cached_property

import numpy as np

import kinefit
from kinefit.bodies.marker_sets import placement
from kinefit.bodies.motion import UP_AXES
from kinefit.geometry.camera import Rig
from kinefit.observations import KeypointFrame
from kinefit.simulation import (
    KINECT,
    TOF,
    SimulatedScene,
    cut,
    in_front,
    picture,
    simulate_depth,
    simulate_keypoints,
    squat_and_wave,
    studio_rig,
)
from kinefit.simulation.rendering.scenes import COLOUR


class World:
    """Half a second of a person who squats and waves, y up."""

    frames = 12

    @cached_property
    def motion(self):
        return cut(squat_and_wave(up="y"), 0, self.frames)

    @property
    def body(self):
        return self.motion.body

    @cached_property
    def rig(self):
        """Four cameras, cam01 to cam04."""
        rig = studio_rig(self.motion)
        return Rig(tuple(replace(camera, name=f"cam{i + 1:02d}") for i, camera in enumerate(rig)))

    @cached_property
    def keypoints(self):
        return simulate_keypoints(self.motion, self.rig, "BODY_25B")

    def seen(self, step):
        """Keypoint frames of all cameras at one step."""
        return [
            KeypointFrame(k.camera, float(self.motion.times[step]), k.names, k.points[step, 0], k.confidence[step, 0],
                          k.keypoint_set)
            for k in self.keypoints
        ]  # fmt: skip

    @property
    def steps(self):
        return [self.seen(i) for i in range(self.frames)]

    @cached_property
    def depth(self):
        """A depth video of the sensor `tof`, in an empty room."""
        return simulate_depth(self.motion, self.depth_camera, TOF, seed=1)

    @cached_property
    def depth_camera(self):
        return replace(in_front(self.motion, TOF.camera(), near=TOF.near, far=TOF.far), name="kinect")

    @cached_property
    def colour(self):
        """A small colour camera in front of the person."""
        sensor = replace(COLOUR, size=(320, 240), focal=240.0)
        return in_front(self.motion, sensor.camera(), near=0.5, far=8.0)

    def image(self, step):
        """(240, 320, 3) RGB."""
        return picture(SimulatedScene(self.motion), step, self.colour)[..., ::-1].copy()

    def markers(self, frames=None):
        """Markers of the set CMU_41 with 1 mm noise."""
        truth, random = squat_and_wave(rate=60), np.random.default_rng(0)
        points = placement(truth.body, "CMU_41").points
        points = replace(points, points=points.points + 0.01 * random.standard_normal((len(points), 3)))
        x = truth.positions(points) + 0.001 * random.standard_normal((len(truth), len(points), 3))
        return kinefit.Markers(points.names, truth.rate, x[:frames], up=truth.up)

    @property
    def up(self):
        return UP_AXES[self.motion.up]


@cache
def world():
    return World()


__all__ = ["KINECT", "World", "world"]
