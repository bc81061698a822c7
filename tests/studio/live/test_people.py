"""The person who is followed among several, and one who is far from where the body was."""

import numpy as np
import pytest

from kinefit.errors import ObservationError, TakeError
from kinefit.observations import KeypointFrame, Keypoints
from kinefit.studio.live.people import LivePerson


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


def of_two(scene, step):
    return [k.rows(slice(step, step + 1), float(k.times[step])) for k in scene.two]


def test_people_are_numbered_from_the_left(scene):
    person = LivePerson(scene.rig)
    assert (person.camera, person.count, person.number) == ("", 0, None)
    person.frames(of_two(scene, 4), scene.motion.body, scene.motion.state(3))
    other, own = (np.nanmedian(scene.two[0].points[4, p, :, 0]) for p in (0, 1))
    assert person.camera == scene.rig.names[0] and person.count == 2 and person.number == (2 if own > other else 1)
    for expected in [scene.rig.names[0]] * 59 + [scene.rig.names[1]]:  # cameras take turns; one that is gone has none
        person.frames(of_two(scene, 5)[1:], scene.motion.body, scene.motion.state(4))
        assert person.camera == expected
    person.frames([k.of_one(np.array([-1])) for k in of_two(scene, 5)], scene.motion.body, scene.motion.state(4))
    assert (person.count, person.number) == (0, None)


def test_who_is_chosen_is_tracked_from_then_on_in_all_images(scene):
    person, body = LivePerson(scene.rig), scene.motion.body
    person.frames(of_two(scene, 4), body, scene.motion.state(3))
    before = person.number
    with pytest.raises(ObservationError, match="person 3 of 2 in view"):
        person.choose(3)
    person.choose(3 - before)
    assert person.frames(of_two(scene, 5)[1:2], body, None) == []  # not the camera of the numbers: no guess
    for step in (5, 6):
        frames = person.frames(of_two(scene, step), body, None)
        assert len(frames) == len(scene.rig) and person.number == 3 - before
        assert all(np.array_equal(f.uv, k.points[step, 0], equal_nan=True) for k, f in zip(scene.two, frames))


def test_a_chosen_person_who_has_left_is_given_up(scene):
    person, body = LivePerson(scene.rig), scene.motion.body
    person.frames(of_two(scene, 4), body, scene.motion.state(3))
    person.choose(3 - person.number)
    alone = [k.of_one(np.array([1])) for k in of_two(scene, 5)]
    found = [bool(person.frames(alone, body, None)) for _ in range(70)]
    assert not any(found[:60]) and all(found[61:])
