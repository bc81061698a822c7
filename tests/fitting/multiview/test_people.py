"""All people: each keeps their own detections in every camera, whoever comes, goes, crosses or hides another."""

from dataclasses import replace

import numpy as np
import pytest
from tests.oracle import posture, rig_around

from kinefit.bodies import BodyState, load_body
from kinefit.fitting.multiview import people
from kinefit.fitting.multiview.association import some_columns
from kinefit.fitting.multiview.people import people_of, views_needed
from kinefit.observations import Keypoints

BODY = load_body("humanoid")
SET = "BODY_25B"
NAMES = BODY.keypoints(SET).names
RIG = rig_around((0.0, 0.0, 0.0))
RATE = 25.0


def along(path, seed):
    """(F, K, 3) [m] keypoints of a person whose root goes along a path (F, 3), swinging its limbs."""
    out = []
    for f, place in enumerate(path):
        state = posture(BODY, seed, 0.2)
        T = np.array(state.T_world_root)
        T[:3, 3] = place
        angles = state.angles * np.cos(2 * np.pi * f / RATE)
        out.append(BODY.positions(BodyState(T, angles), BODY.keypoints(SET)))
    return np.array(out)


def line(a, b, frames):
    """(F, 3) from one place to another."""
    return np.linspace(a, b, frames)


def records(people, *, unseen=(), seed=0, noise=3.0, outliers=0.0, rig=RIG):
    """Keypoints in every camera, people in an order that changes from frame to frame; and where each is in the list.

    unseen: (person, camera or None for all, first frame, last frame).
    """
    random = np.random.default_rng(seed)
    frames, count = len(people[0]), len(people)
    out, truth = [], []
    for c, camera in enumerate(rig):
        order = np.stack([random.permutation(count) for _ in range(frames)])
        points = np.stack([camera.project(x) for x in people], axis=1)
        points = points + noise * random.normal(size=points.shape)
        wild = random.uniform(size=points.shape[:3]) < outliers
        points[wild] += random.normal(scale=100.0, size=(int(wild.sum()), 2))
        confidence = random.uniform(0.8, 1.0, points.shape[:3])
        for person, where, first, last in unseen:
            if where in (None, c):
                points[first:last, person], confidence[first:last, person] = np.nan, 0.0
        gone = (confidence == 0.0).all(axis=2)
        points = np.take_along_axis(points, order[:, :, None, None], axis=1)
        confidence = np.take_along_axis(confidence, order[:, :, None], axis=1)
        out.append(Keypoints(camera.name, SET, NAMES, RATE, points, confidence))
        truth.append(np.where(gone, -1, np.argsort(order, axis=1)))
    return out, truth  # truth[camera][frame, person] = place in the list


def owners(found, truth):
    """(people found, cameras, F) the true person whose detection each has, -1 for none."""
    out = np.full((len(found), len(truth), len(truth[0])), -1)
    for i, one in enumerate(found):
        for c, (chosen, places) in enumerate(zip(one.chosen, truth)):
            match = (places == chosen[:, None]) & (chosen[:, None] >= 0)
            out[i, c] = np.where(match.any(axis=1), match.argmax(axis=1), -1)
    return out


def check_each_is_one(found, truth, least=0.98):
    """Everybody is found, never exchanged, and nearly all that was detected is theirs."""
    count = truth[0].shape[1]
    whose = owners(found, truth)
    assert len(found) == count
    who = [np.unique(w[w >= 0]) for w in whose]
    assert sorted(w[0] for w in who) == list(range(count)) and all(len(w) == 1 for w in who)
    for i, w in enumerate(who):
        there = np.stack([t[:, w[0]] >= 0 for t in truth])
        assert np.mean((whose[i] >= 0)[there]) >= least


@pytest.mark.parametrize("seed", range(3))
def test_two_who_cross(seed):
    a = along(line((-1.0, 0.0, 0.15), (1.0, 0.0, 0.15), 50), seed)
    b = along(line((1.0, 0.0, -0.15), (-1.0, 0.0, -0.15), 50), seed + 10)
    check_each_is_one(*_found(records([a, b], seed=seed, outliers=0.1)))


def _found(told, rig=RIG):
    keypoints, truth = told
    return people_of(rig, keypoints), truth


@pytest.mark.parametrize("off", [0.05, 0.1, 0.14])  # [m] across the views of two cameras each
def test_two_do_not_share_the_views_of_one(off):
    keypoints, _ = records([along(line((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 2), 1)])
    search = people._Search(RIG, keypoints)
    x = along([(0.0, 0.0, 0.0)], 1)[0][some_columns(len(NAMES))]
    search.tracks = [people._OpenTrack(x + d, np.zeros_like(x), 0, 0, 0) for d in ((off, 0, 0), (0, 0, off))]
    search._continue_tracks(1, search.tracks)
    assert [len(track.nodes.get(1, ())) for track in search.tracks] == [2, 0]


@pytest.mark.parametrize(("other_seen", "off", "kept"), [(False, 0.35, 0), (True, 0.35, 1), (False, 0.1, 1)])
def test_a_single_view_off_the_prediction_is_not_shared_out(other_seen, off, kept):
    beside = next(iter(RIG)).T_camera_world[0, :3]  # across the image of the first camera
    a, b = np.zeros(3), -0.9 * beside
    seen = [along(line(x, x, 2), k) for k, x in ((1, off * beside), (2, b))]
    hidden = [(k, c, 0, 2) for k in (0, 1) for c in range(1, len(RIG))] + [(1, 0, 0, 2)] * (not other_seen)
    search = people._Search(RIG, records(seen, unseen=hidden)[0])
    columns = some_columns(len(NAMES))
    search.tracks = [
        people._OpenTrack(x[0][columns], np.zeros((len(columns), 3)), 0, 0, 0)
        for x in (along([a], 1), along([b], 2))
    ]
    search._continue_tracks(1, search.tracks)
    assert [len(track.nodes.get(1, ())) for track in search.tracks] == [kept, int(other_seen)]


def test_five_people_in_a_crowd():
    places = [(0.0, 0.0, 0.0), (0.7, 0.0, 0.2), (-0.7, 0.0, 0.3), (0.2, 0.0, 0.8), (-0.3, 0.0, -0.7)]
    people = [along(line(p, np.add(p, (0.3, 0.0, 0.1)), 30), k) for k, p in enumerate(places)]
    check_each_is_one(*_found(records(people, outliers=0.1)))


def test_one_whom_another_hides_in_most_cameras_keeps_the_name():
    a = along(line((0.0, 0.0, 0.0), (0.2, 0.0, 0.0), 75), 1)
    b = along(line((0.5, 0.0, 0.3), (0.6, 0.0, 0.3), 75), 2)
    hidden = [(1, c, 15, 60) for c in range(len(RIG) - 1)]
    check_each_is_one(*_found(records([a, b], unseen=hidden)), least=0.95)


def test_who_leaves_and_comes_back_is_the_same():
    a = along(line((0.0, 0.0, 0.0), (0.4, 0.0, 0.0), 100), 1)
    b = along(line((1.0, 0.0, 0.6), (1.0, 0.0, 0.9), 100), 2)
    found, truth = _found(records([a, b], unseen=[(1, None, 35, 65)]))
    check_each_is_one(found, truth)
    other = found[1]
    np.testing.assert_array_equal(other.views[35:65], 0)
    assert found[0].confidence > other.confidence


@pytest.mark.parametrize("seed", range(3))
def test_second_detections_of_one_do_not_stand_in_for_another_who_left(seed):
    a = along(line((0.0, 0.0, 0.0), (0.4, 0.0, 0.0), 100), 1)
    b = along(line((0.7, 0.0, 0.3), (0.7, 0.0, 0.5), 100), 2)
    random = np.random.default_rng(seed)
    keypoints, truth = records([a, b, a], unseen=[(1, None, 35, 65)], seed=seed)
    partial = []
    for k, places in zip(keypoints, truth):
        less = np.array(k.confidence)
        for f, place in enumerate(places[:, 2]):
            less[f, place] *= 0.6 * (random.uniform(size=len(NAMES)) < 0.7) * (random.uniform() < 0.5)
        partial.append(replace(k, confidence=less))
    found = people_of(RIG, partial)
    same = [np.where(places == 2, 0, places) for places in owners(found, truth)]
    assert sorted(int(w[w >= 0][0]) for w in same) == [0, 1]
    assert all(len(np.unique(w[w >= 0])) == 1 for w in same)


def test_who_is_seen_by_too_few_at_first_has_their_beginning_too():
    a = along(line((0.0, 0.0, 0.0), (0.4, 0.0, 0.0), 60), 1)
    b = along(line((1.0, 0.0, 0.6), (0.8, 0.0, 0.6), 60), 2)
    early = [(1, c, 0, 15) for c in range(2, len(RIG))]
    check_each_is_one(*_found(records([a, b], unseen=early)))


def test_a_view_whose_sides_the_detector_exchanged_stays_with_its_person():
    from kinefit.observations.recordings import mirror_name

    a = along(line((0.0, 0.0, 0.0), (0.4, 0.0, 0.0), 60), 1)
    b = along(line((1.0, 0.0, 0.6), (0.8, 0.0, 0.6), 60), 2)
    keypoints, truth = records([a, b], outliers=0.1)
    points = np.array(keypoints[1].points)
    points[20:45] = points[20:45][:, :, [NAMES.index(mirror_name(n)) for n in NAMES]]
    keypoints[1] = replace(keypoints[1], points=points)
    found = people_of(RIG, keypoints)
    check_each_is_one(found, truth)


def test_twelve_are_found_and_each_is_one():
    places = [(1.0 * (k % 4 - 1.5), 0.0, 1.0 * (k // 4 - 1.0)) for k in range(12)]
    told = records([along(line(p, p, 25), k) for k, p in enumerate(places)], outliers=0.1)
    check_each_is_one(*_found(told), least=0.95)


def test_of_whom_every_picture_shows_the_upper_half_is_found():
    a = along(line((0.0, 0.0, 0.0), (0.4, 0.0, 0.0), 40), 1)
    keypoints, truth = records([a, along(line((1.0, 0.0, 0.6), (0.8, 0.0, 0.6), 40), 2)])
    low = np.array([any(part in name for part in ("Knee", "Ankle", "Toe", "Heel")) for name in NAMES])
    cut = [replace(k, points=np.where(low[:, None], np.nan, k.points), confidence=np.where(low, 0.0, k.confidence))
           for k in keypoints]  # fmt: skip
    check_each_is_one(people_of(RIG, cut), truth)


def test_a_poster_that_one_camera_sees_is_nobody():
    a = along(line((0.0, 0.0, 0.0), (0.4, 0.0, 0.0), 40), 1)
    poster = np.repeat(along(line((1.0, 0.0, 0.6), (1.0, 0.0, 0.6), 1), 2), 40, axis=0)
    found, truth = _found(records([a, poster], unseen=[(1, c, 0, 40) for c in range(1, len(RIG))]))
    assert len(found) == 1 and np.all(owners(found, truth)[0] == 0)


def test_a_passer_by_is_nobody():
    a = along(line((0.0, 0.0, 0.0), (0.4, 0.0, 0.0), 60), 1)
    b = along(line((1.0, 0.0, 0.6), (0.8, 0.0, 0.6), 60), 2)
    found, truth = _found(records([a, b], unseen=[(1, None, 0, 45)]))
    assert len(found) == 1 and np.all(owners(found, truth)[0] == 0)
    in_two = [(1, c, 0, 60) for c in range(2, len(RIG))]
    assert len(_found(records([a, b], unseen=in_two))[0]) == 1


def test_two_are_found_of_whom_the_detector_looked_at_every_fourth_image():
    """And a third, seen in a quarter of the looks, is a passer-by as in every image."""
    paths = [(0.0, 0.0, 0.4, 0.0), (0.9, 0.7, 1.0, 0.6), (-1.0, -0.6, -0.8, -0.6)]
    walking = [along(line((a, 0.0, b), (c, 0.0, d), 60), seed) for seed, (a, b, c, d) in enumerate(paths)]
    keypoints, truth = records(walking, unseen=[(2, None, 0, 45)])
    looked = np.arange(60) % 4 == 0
    keypoints = [replace(k.without(~looked), looked=looked) for k in keypoints]
    truth = [np.where(looked[:, None], places, -1) for places in truth]
    whose = owners(people_of(RIG, keypoints), truth)
    assert sorted(np.unique(w[w >= 0]).tolist() for w in whose) == [[0], [1]]
    assert (whose >= 0)[:, :, looked].mean() > 0.9


def test_two_cameras_are_enough_where_there_are_no_more():
    assert [views_needed(n) for n in (1, 2, 3, 4, 8)] == [1, 2, 2, 3, 3]
    rig = RIG.select(RIG.names[:2])
    a = along(line((0.0, 0.0, 0.0), (0.4, 0.0, 0.0), 40), 1)
    b = along(line((0.9, 0.0, 0.7), (1.0, 0.0, 0.6), 40), 2)
    found, truth = _found(records([a, b], rig=rig), rig)
    whose = owners(found, truth)
    assert len(found) == 2 and all(len(np.unique(w[w >= 0])) == 1 for w in whose)


def test_what_is_told_of_people():
    fast = along(line((0.0, 0.0, 0.0), (2.0, 0.0, 0.0), 50), 1)
    still = np.repeat(along(line((0.0, 0.0, 1.0), (0.0, 0.0, 1.0), 1), 2), 50, axis=0)
    found, truth = _found(records([fast, still]))
    whose = owners(found, truth)
    runner, other = sorted(found, key=lambda one: -one.speed)
    assert whose[found.index(runner)].max() == 0 and whose[found.index(other)].max() == 1
    assert abs(runner.speed - 1.0) < 0.4 and other.speed < 0.3
    np.testing.assert_allclose(other.place, np.median(still[0], axis=0), atol=0.25)


def test_people_of_another_detector_go_along():
    a = along(line((0.0, 0.0, 0.0), (0.4, 0.0, 0.0), 40), 1)
    b = along(line((0.9, 0.0, 0.6), (1.0, 0.0, 0.6), 40), 2)
    keypoints, truth = records([a, b])
    others, there = records([a, b], seed=5)
    second = [Keypoints(k.camera, "COCO", k.names[:17], RATE, k.points[:, :, :17], k.confidence[:, :, :17])
              for k in others[:2]]  # fmt: skip
    found = people_of(RIG, [*keypoints, *second])
    check_each_is_one(found, [*truth, *there[:2]])


def test_nobody_is_nobody():
    assert people_of(RIG, []) == []
    keypoints, _ = records([along(line((0, 0, 0), (0, 0, 0), 10), 0)], unseen=[(0, None, 0, 10)])
    assert people_of(RIG, keypoints) == []
