"""The person who is followed among several, and one who is far from where the body was."""

import numpy as np
import pytest

from kinefit.errors import TakeError
from kinefit.live.people import LivePerson
from kinefit.observations import KeypointFrame, Keypoints


def beside(scene, step, shift=600.0, order=(0, 1)):
    """Records of one frame with the person, and the same shifted in the images, in some order."""
    out = []
    for k in scene.keypoints:
        one = k.rows(slice(step, step + 1), float(k.times[step]))
        both = np.concatenate([one.points, one.points * 0.5 + shift], axis=1)[:, list(order)]
        sure = np.concatenate([one.confidence] * 2, axis=1)
        out.append(Keypoints(k.camera, k.keypoint_set, k.names, k.rate, both, sure, time_offset=one.time_offset))
    return out


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_the_one_who_fits_the_body_is_followed(scene, order):
    state = scene.motion.state(3)
    frames = LivePerson(scene.rig).frames(beside(scene, 4, order=order), scene.motion.body, state)
    assert len(frames) == len(scene.rig)
    for k, f in zip(scene.keypoints, frames):
        assert isinstance(f, KeypointFrame) and np.array_equal(f.uv, k.points[4, 0], equal_nan=True)


def test_without_a_pose_the_cameras_agree_on_somebody(scene):
    frames = LivePerson(scene.rig).frames(beside(scene, 4, order=(1, 0)), scene.motion.body, None)
    assert all(np.array_equal(f.uv, k.points[4, 0], equal_nan=True) for k, f in zip(scene.keypoints, frames))


@pytest.mark.parametrize("who", ["largest", "nearest 0 0 1"])
def test_who_is_asked_for_is_taken_to_begin_with(scene, who):
    frames = LivePerson(scene.rig, who).frames(beside(scene, 4), scene.motion.body, None)
    assert all(np.array_equal(f.uv, k.points[4, 0], equal_nan=True) for k, f in zip(scene.keypoints, frames))


def test_nobody_gives_no_frames(scene):
    empty = [k.rows(slice(0, 1), 0.0).of_one(np.array([-1])) for k in scene.keypoints]
    assert LivePerson(scene.rig).frames(empty, scene.motion.body, None) == []


@pytest.mark.parametrize("who", ["moving", 2])
def test_who_is_known_only_when_all_is_over_is_refused(scene, who):
    with pytest.raises(TakeError, match="needs the whole recording"):
        LivePerson(scene.rig, who)
