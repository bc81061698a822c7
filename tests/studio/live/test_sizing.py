"""The person's lengths in a live session: what is beside it holds nothing up."""

import os
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context

import pytest

from kinefit.bodies.motion import UP_AXES
from kinefit.fitting.frame.results import FrameResult
from kinefit.fitting.tracking.tracker import Tracker
from kinefit.observations import KeypointFrame
from kinefit.sensors.settings import TrackSettings
from kinefit.simulation import simulate_keypoints, squat_and_wave, studio_rig
from kinefit.studio.live.people import LiveSize


@pytest.fixture
def broken():
    """Processes of which one was ended from outside."""
    pool = ProcessPoolExecutor(1, mp_context=get_context("spawn"))
    with pytest.raises(BrokenProcessPool):
        pool.submit(os._exit, 1).result()
    yield pool
    pool.shutdown()


def test_a_process_that_was_ended_holds_no_session_up(broken):
    motion = squat_and_wave(rate=5.0, duration=12.0)
    rig = studio_rig(motion, cameras=2)
    records = simulate_keypoints(motion, rig, "BODY_25B")
    tracker = Tracker(motion.body, rig, rate=5.0, up=UP_AXES[motion.up])
    tracker.start_at(motion.state(0))
    size = LiveSize(motion.body, rig, sigma={}, settings=TrackSettings(), up=motion.up)
    size._pool = broken
    for k, at in enumerate(motion.times):
        frames = [
            KeypointFrame(r.camera, float(at), r.names, r.points[k, 0], r.confidence[k, 0], r.keypoint_set)
            for r in records
        ]
        result = tracker.update(frames)
        assert isinstance(result, FrameResult)
        assert size.after(frames, result) is None
        if size.outcome:
            break
    assert "its process ended" in size.outcome
    assert size.after(frames, result) is None and not size._steps  # and it is not tried again
    size.restart()  # until there is another person
    assert size.after(frames, result) is None and size._steps == [frames] and not size.outcome
    size.close()
