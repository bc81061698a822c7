"""Which person: the same one in all cameras and frames, whatever the order in which detectors list people."""

import numpy as np
import pytest
from tests.oracle import posture, rig_around

from kinefit.bodies import BodyState, load_body
from kinefit.errors import TrackingError
from kinefit.fitting.multiview.association import choose_people
from kinefit.geometry import se3
from kinefit.observations import Keypoints
from kinefit.readers.landmarks.keypoint_sets import keypoint_names

BODY = load_body("humanoid")
SET = "BODY_25B"
NAMES = BODY.keypoints(SET).names
RIG = rig_around((0.0, 0.0, 0.0))


def walker(start, frames=12, seed=0):
    """(F, K, 3) [m] keypoints of a person who walks along x at 1 m/s (25 frames a second)."""
    state = posture(BODY, seed, 0.2)
    out = []
    for f in range(frames):
        T = np.array(state.T_world_root)
        T[:3, 3] = np.asarray(start) + (f / 25.0, 0.0, 0.0)
        out.append(BODY.positions(BodyState(T, state.angles), BODY.keypoints(SET)))
    return np.array(out)


def records(people, *, sure=1.0, seed=0, noise=3.0, hidden=(), rig=RIG, keypoint_set=SET):
    """Keypoints of people (F, K, 3) in every camera, in an order that changes from frame to frame; and who is where.

    `sure` is each person's confidence; hidden: (person, camera) pairs that are not seen.
    """
    random = np.random.default_rng(seed)
    frames, count = len(people[0]), len(people)
    sure = np.broadcast_to(sure, count)
    out, truth = [], []
    for c, camera in enumerate(rig):
        order = np.stack([random.permutation(count) for _ in range(frames)])
        points = np.stack([camera.project(x) for x in people], axis=1)
        points = points + noise * random.normal(size=points.shape)
        confidence = np.broadcast_to(sure[:, None], points.shape[:3]) * random.uniform(0.8, 1.0, points.shape[:3])
        for person, where in hidden:
            if where == c:
                points[:, person], confidence[:, person] = np.nan, 0.0
        points = np.take_along_axis(points, order[:, :, None, None], axis=1)
        confidence = np.take_along_axis(confidence, order[:, :, None], axis=1)
        out.append(Keypoints(camera.name, keypoint_set, keypoint_names(keypoint_set), 25.0, points, confidence))
        truth.append(np.argsort(order, axis=1))
    return out, truth  # truth[camera][frame, person] = place in the list


MAIN, OTHER = walker((0.0, 0.0, 0.0)), walker((0.9, 0.1, -0.8), seed=3)


def test_one_person_needs_no_choice():
    keypoints, _ = records([MAIN])
    for chosen in choose_people(RIG, keypoints):
        assert chosen.dtype.kind == "i"
        np.testing.assert_array_equal(chosen, 0)


@pytest.mark.parametrize("seed", range(4))
def test_the_surer_of_two_is_followed_in_all_cameras(seed):
    keypoints, truth = records([MAIN, OTHER], sure=(1.0, 0.5), seed=seed)
    for chosen, places in zip(choose_people(RIG, keypoints), truth, strict=True):
        np.testing.assert_array_equal(chosen, places[:, 0])


@pytest.mark.parametrize("seed", range(4))
def test_one_of_two_alike_is_followed_throughout(seed):
    """Two people, equally well seen: whoever it is, it is one and the same in every camera and frame."""
    keypoints, truth = records([MAIN, OTHER], seed=seed)
    who = []
    for chosen, places in zip(choose_people(RIG, keypoints), truth, strict=True):
        who.append(np.argmax(places == chosen[:, None], axis=1))
    assert np.all(np.array(who) == who[0][0])


def blind(record, places, person, frames):
    """The record without a person in some frames."""
    points, confidence = np.array(record.points), np.array(record.confidence)
    frames = np.arange(len(record))[frames]
    points[frames, places[frames, person]], confidence[frames, places[frames, person]] = np.nan, 0.0
    return Keypoints(record.camera, SET, NAMES, record.rate, points, confidence)


@pytest.mark.parametrize("when", [slice(18, 50), slice(0, 32), slice(12, 38)])
def test_who_is_there_longer_is_followed_throughout(when):
    """Another person who is better seen for a while does not stand in for the one who is seen all the time."""
    people = walker((0.0, 0.0, 0.0), frames=50), walker((0.9, 0.1, -0.8), frames=50, seed=3)
    keypoints, truth = records(people, sure=(0.8, 1.0))
    keypoints = [blind(k, places, 1, when) for k, places in zip(keypoints, truth, strict=True)]
    for chosen, places in zip(choose_people(RIG, keypoints), truth, strict=True):
        np.testing.assert_array_equal(chosen, places[:, 0])


def test_who_comes_back_after_a_gap_is_followed_on():
    """And nobody is followed while the person is away, as a bystander far off is somebody else."""
    people = walker((0.0, 0.0, 0.0), frames=50), walker((1.5, 0.5, -1.5), frames=50, seed=3)
    keypoints, truth = records(people, sure=(1.0, 0.6))
    keypoints = [blind(k, places, 0, slice(20, 24)) for k, places in zip(keypoints, truth, strict=True)]
    for chosen, places in zip(choose_people(RIG, keypoints), truth, strict=True):
        away = np.arange(50)[20:24]
        np.testing.assert_array_equal(chosen[away], -1)
        np.testing.assert_array_equal(np.delete(chosen, away), np.delete(places[:, 0], away))


def test_a_poster_that_one_camera_sees_is_left_out():
    keypoints, truth = records([MAIN, OTHER], sure=(0.7, 1.0), hidden=[(1, 1), (1, 2), (1, 3)])
    for chosen, places in zip(choose_people(RIG, keypoints), truth, strict=True):
        np.testing.assert_array_equal(chosen, places[:, 0])


def test_where_the_person_is_not_seen_nobody_is_chosen():
    """A bystander does not stand in for the person in a camera that does not see the person."""
    keypoints, truth = records([MAIN, OTHER], sure=(1.0, 0.6), hidden=[(0, 2)])
    chosen = choose_people(RIG, keypoints)
    np.testing.assert_array_equal(chosen[2], -1)
    for c in (0, 1, 3):
        np.testing.assert_array_equal(chosen[c], truth[c][:, 0])


def test_exchanged_sides_in_one_camera_do_not_make_another_person():
    keypoints, truth = records([MAIN, OTHER], sure=(1.0, 0.5))
    mirror = [NAMES.index(other(n)) for n in NAMES]
    turned = Keypoints(
        "cam3", SET, NAMES, 25.0, keypoints[2].points[:, :, mirror], keypoints[2].confidence[:, :, mirror]
    )
    chosen = choose_people(RIG, [*keypoints[:2], turned, keypoints[3]])
    for c in (0, 1, 3):
        np.testing.assert_array_equal(chosen[c], truth[c][:, 0])
    assert np.mean(chosen[2] == truth[2][:, 0]) + np.mean(chosen[2] == -1) == 1.0


def other(name):
    return {"L": "R", "R": "L"}[name[0]] + name[1:] if name[0] in "LR" and name[1].isupper() else name


def test_a_person_of_whom_too_little_is_seen_is_none():
    keypoints, _ = records([MAIN])
    points = np.array(keypoints[0].points)
    points[:, :, 3:] = np.nan
    few = Keypoints("cam1", SET, NAMES, 25.0, points, keypoints[0].confidence)
    np.testing.assert_array_equal(choose_people(RIG, [few, *keypoints[1:]])[0], -1)


def test_nobody_anywhere_is_told():
    nothing = [
        Keypoints(c.name, SET, NAMES, 25.0, np.full((3, 2, len(NAMES), 2), np.nan), np.zeros((3, 2, len(NAMES))))
        for c in RIG
    ]
    with pytest.raises(TrackingError, match="no person is seen.*keypoints are of this"):
        choose_people(RIG, nothing)


def test_a_camera_without_room_for_anybody():
    keypoints, truth = records([MAIN, OTHER], sure=(1.0, 0.5))
    empty = Keypoints(
        "cam4", SET, NAMES, 25.0, np.empty((len(MAIN), 0, len(NAMES), 2)), np.empty((len(MAIN), 0, len(NAMES)))
    )
    chosen = choose_people(RIG, [*keypoints[:3], empty])
    np.testing.assert_array_equal(chosen[3], -1)
    np.testing.assert_array_equal(chosen[0], truth[0][:, 0])


def test_a_person_whom_a_detector_cuts_in_two_for_a_moment_is_not_lost():
    """Legs and trunk as two people in one camera and frame: the others are still followed there."""
    person, other = walker((0.0, 0.0, 0.0)), walker((1.5, 1.0, 0.0), seed=1)
    seen, _ = records([person, other], sure=(1.0, 0.5))
    first = seen[0]
    points = np.full((len(first), 3, *first.points.shape[2:]), np.nan)
    confidence = np.zeros(points.shape[:3])
    points[:, :2], confidence[:, :2] = first.points, first.confidence
    lower, upper = (
        np.array([n[1:].startswith(parts) for n in NAMES])
        for parts in (("Knee", "Ankle", "BigToe", "SmallToe", "Heel"), ("Shoulder", "Elbow", "Wrist"))
    )
    whole = choose_people(RIG, seen)
    cut = int(whole[0][6])
    points[6, 2, upper], confidence[6, 2, upper] = points[6, cut, upper], confidence[6, cut, upper]
    points[6, cut, ~lower], confidence[6, cut, ~lower] = np.nan, 0.0
    halved = Keypoints(first.camera, first.keypoint_set, first.names, first.rate, points, confidence)
    chosen = choose_people(RIG, [halved, *seen[1:]])
    for before, now in zip(whole[1:], chosen[1:], strict=True):
        np.testing.assert_array_equal(now, before)


def of_another_detector(record, count=17):
    """A record of fewer points, as of another keypoint set."""
    part = {"points": record.points[:, :, :count], "confidence": 0.9 * record.confidence[:, :, :count]}
    return Keypoints(record.camera, "COCO", record.names[:count], record.rate, **part)


def test_a_second_detector_shows_the_same_person_and_none_is_ignored():
    """Both records of every camera are used in all frames, although each detector lists people in its own order."""
    first, truth = records([MAIN, OTHER], sure=(1.0, 0.5))
    second, there = records([MAIN, OTHER], sure=(0.5, 1.0), seed=7)
    several = [*first, *(of_another_detector(k) for k in second)]
    chosen = choose_people(RIG, several)
    who = [np.argmax(places == c[:, None], axis=1) for c, places in zip(chosen, [*truth, *there], strict=True)]
    assert all(np.all(c >= 0) for c in chosen) and len(np.unique(who)) == 1


def test_where_the_surer_detector_sees_nobody_the_other_goes_on():
    first, _ = records([MAIN])
    second, _ = records([MAIN], seed=3)
    blank = first[2].points.copy(), first[2].confidence.copy()
    blank[0][:5], blank[1][:5] = np.nan, 0.0
    first[2] = Keypoints(first[2].camera, SET, NAMES, 25.0, *blank)
    chosen = choose_people(RIG, [*first, *(of_another_detector(k) for k in second)])
    np.testing.assert_array_equal(chosen[2][:5], -1)
    np.testing.assert_array_equal(chosen[len(first) + 2], 0)


@pytest.mark.parametrize("meshes_first", [False, True])
def test_a_face_mesh_goes_with_the_person_whose_face_it_is(meshes_first):
    body = load_body("humanoid_face")
    rig = rig_around((0.0, 0.0, 0.0))
    people = {"BODY_25B": [], "MEDIAPIPE_478": []}
    for place in (-0.5, 0.5):
        state = BodyState(se3.transform(np.eye(3), np.array([0.0, 0.0, place])), body.tree.usual)
        for name, seen in people.items():
            points = body.keypoints(name)
            full = np.full((len(keypoint_names(name)), 3), np.nan)
            full[[keypoint_names(name).index(n) for n in points.names]] = body.positions(state, points)
            seen.append(np.tile(full, (12, 1, 1)))
    pose, where_pose = records(people["BODY_25B"], sure=(1.0, 0.8), seed=1, rig=rig)
    mesh, where_mesh = records(people["MEDIAPIPE_478"], seed=2, rig=rig, keypoint_set="MEDIAPIPE_478")
    both = [*mesh, *pose] if meshes_first else [*pose, *mesh]
    found, truth = choose_people(rig, both), where_mesh + where_pose if meshes_first else where_pose + where_mesh
    assert all(np.array_equal(chosen, of[:, 0]) for chosen, of in zip(found, truth, strict=True))
