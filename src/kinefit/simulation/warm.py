"""Warm up compiled kernels with a tiny simulated take, before live tracking starts."""

from __future__ import annotations

from kinefit.geometry.camera import Rig
from kinefit.motion import UP_AXES
from kinefit.observations import DepthFrame
from kinefit.simulation import (
    KINECT,
    cut,
    in_front,
    simulate_depth,
    simulate_keypoints,
    squat_and_wave,
    studio_rig,
)
from kinefit.tracking.recording import Recording
from kinefit.tracking.tracker import Tracker
from kinefit.tracking.video import track


def warm_keypoints() -> None:
    """Run the fit of the person, tracking and smoothing once on keypoints."""
    motion = cut(squat_and_wave(), 0, 4)
    rig = studio_rig(motion)
    track(Recording.of_keypoints(rig, simulate_keypoints(motion, rig, "BODY_25B"), up=motion.up), motion.body)


def warm_depth() -> None:
    """Run depth tracking once, without a start pose, so the search for it is included."""
    motion = cut(squat_and_wave(), 0, 3)
    camera = in_front(motion, KINECT.camera(name="kinect"), near=KINECT.near, far=KINECT.far)
    video = simulate_depth(motion, camera, KINECT)
    tracker = Tracker(motion.body, Rig((camera,)), rate=motion.rate, up=UP_AXES[motion.up])
    for i in range(len(motion)):
        tracker.update([DepthFrame("kinect", motion.times[i], video.frame(i).depth)])
