"""Recordings of frames in memory: markers among them tell the person's size; times that do not agree are told."""

from dataclasses import replace

import numpy as np
import pytest
from tests.fitting.subject.measured import Rope
from tests.fitting.tracking.movements import (
    BODY,
    RATE,
    STILL,
    a_motion,
    a_rig,
    depth_frame,
    keypoint_frame,
    marker_frame,
)

from kinefit.errors import ObservationError
from kinefit.fitting.tracking.recording import Recording
from kinefit.fitting.tracking.tracker import Tracker
from kinefit.fitting.tracking.video import track
from kinefit.geometry.camera import Rig
from kinefit.observations import MarkerFrame

LARGER = 1.12


def worn(names, marker_set="", count=30, every=3):
    """Steps of markers on a body 12 % larger than the catalogue's."""
    motion, steps = a_motion(), []
    body = motion.body.scaled(np.full(len(motion.body.scale_groups), LARGER))
    for k in range(count):
        points = body.landmarks.select(names)
        x = body.positions(motion.state(every * k), points)
        x = x + 0.002 * np.random.default_rng(k).normal(size=x.shape)
        steps.append([MarkerFrame("mocap", every * k / RATE, names, x, marker_set)])
    return steps


def test_markers_alone_in_memory_tell_the_size():
    """As a take of the same markers does."""
    steps = worn(BODY.landmarks.names)
    recording = Recording.of_frames(steps, Rig(()), rate=RATE / 3, up="y")
    assert [(len(m.markers), m.marker_set, m.std) for m in recording.markers] == [(30, "", None)]
    motion = track(recording, BODY, settings=STILL)
    ratio = [motion.body.segment_lengths()[n] / length for n, length in BODY.segment_lengths().items()]
    assert np.abs(np.array(ratio) / LARGER - 1.0).max() < 0.02
    assert "shape" in motion.provenance
    as_it_is = track(recording, BODY, settings=STILL, size=False)
    np.testing.assert_array_equal(as_it_is.body.tree.offsets, BODY.tree.offsets)


def test_frames_may_have_some_of_the_markers():
    names = BODY.landmarks.names
    steps = [[marker_frame(i, names[: 4 + i])] for i in range(3)]
    markers = Recording.of_frames(steps, a_rig(), rate=RATE).markers[0].markers
    assert markers.names == names[:6]
    assert np.isfinite(markers.positions).all(axis=2).sum(axis=1).tolist() == [4, 5, 6]
    np.testing.assert_array_equal(markers.positions[1, :5], steps[1][0].positions)


def test_two_frames_of_one_name_are_told():
    """Markers of two systems that are both called mocap; two sets of keypoints of one camera are two sensors."""
    names = BODY.landmarks.names
    steps = [[marker_frame(i, names), marker_frame(i, names, shift=0.1)] for i in range(3)]
    with pytest.raises(ObservationError, match=r"step 0 has two frames of sensor 'mocap'.*own name"):
        Recording.of_frames(steps, a_rig(), rate=RATE)
    other = [[keypoint_frame(0, "left"), replace(keypoint_frame(0, "left"), keypoint_set="BODY_25B")]]
    assert len(Recording.of_frames(other, a_rig(), rate=RATE).keypoints) == 2
    with pytest.raises(ObservationError, match="two sensors are named 'rope'"):
        Recording.of_frames(steps[:0] + [steps[0][:1]], a_rig(), rate=RATE, sensors=(Rope(), Rope()))


@pytest.mark.parametrize("frame", [depth_frame, lambda i: keypoint_frame(i, "left")])
def test_a_time_that_is_not_the_frames_is_told_and_does_no_harm(frame):
    """Within a pause the body is brought to the frames' time by its velocity; beyond it nothing is known of that."""
    tracker = Tracker(BODY, a_rig(), rate=RATE, up=(0, 1, 0), settings=STILL)
    tracker.start_at(a_motion().state(0))
    before = tracker.update([depth_frame(0)])
    with pytest.raises(ObservationError, match=r"is at 0\.\d+ s, its step at 1000\.000 s.*one clock"):
        tracker.update([frame(1)], 1000.0)
    np.testing.assert_array_equal(tracker.state.angles, before.state.angles)
    assert tracker.update([frame(1)], 1 / RATE).time == pytest.approx(1 / RATE)


def test_a_part_has_the_start_and_the_poses_of_its_steps():
    state = BODY.default_state()
    whole = Recording(np.arange(300) / RATE, RATE, Rig(()), start=(250, state), poses={10: state, 250: state})
    part = whole.part(slice(200, 300))
    assert part.start == (50, state)
    assert dict(part.poses) == {50: state}
    assert whole.part(slice(0, 100)).start is None
