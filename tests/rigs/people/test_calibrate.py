"""Where cameras stand, from people alone."""

from dataclasses import replace

import numpy as np
import pytest
from tests.rigs.people_data import BODY, ERRORS, errors, room, seen, walker

from kinefit.errors import CalibrationError
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.rigs.people.calibrate import calibrate_people, first_rig, settled
from kinefit.rigs.people.skeletons import steady_person
from kinefit.simulation import simulate_keypoints

UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def found():
    nowhere = tuple(c.with_pose(np.eye(4)) for c in room())
    return calibrate_people(nowhere, seen(), BODY, sigma=2.0, height=BODY.stature)


def test_poses_come_from_nothing(found):
    turn, place = errors(found.rig, room())
    assert turn < 0.1 and place < 8
    assert found.from_scratch and found.confident
    assert np.median([c.residual_after for c in found.cameras.values()]) < 3.5


def test_the_floor_is_level_and_the_scale_right(found):
    from kinefit.rigs.refine.gauge import aligned

    _, T, factor = aligned(found.rig, room())
    assert np.degrees(np.arccos(T[2, 2])) < 4.0
    assert factor == pytest.approx(1.0, abs=0.02)
    feet = found.motion.positions(found.motion.body.landmarks.select(("l_heel", "r_heel")))
    assert abs(np.percentile(feet[..., 2], 20)) < 0.05
    first = found.rig.cameras[0].centre_world
    assert first[0] > 2.0 and abs(first[1]) < 1e-6
    assert "height zero" in found.gauge and "tall" in found.gauge


def test_the_world_stands_as_it_is_asked_to(found):
    x = walker().positions()
    rest = BODY.points_rest(BODY.landmarks)[:, 1]
    tilted = se3.exp(np.array([1.0, 2.0, -1.0, 0.3, -0.5, 2.0]))
    rig = settled(
        room().moved(tilted), se3.apply(tilted, x), rest - rest.min(),
        balance=se3.apply(tilted, walker().centre_of_mass), up="y",
    )
    heights = [c.centre_world[1] for c in rig]
    np.testing.assert_allclose(heights, [c.centre_world[2] for c in room()], atol=0.25)


def test_two_cameras_are_enough_when_they_stand_apart():
    pair, keypoints = room().select(("cam01", "cam02")), seen()[:2]
    result = calibrate_people(tuple(pair), keypoints, BODY, sigma=2.0)
    turn, _ = errors(result.rig, pair)
    assert turn < 0.5


def test_nearly_opposite_cameras_work_or_are_refused():
    rig = room()
    middle = walker().Ts_world_root[:, :3, 3].mean(axis=0)
    turned = se3.transform(se3.exp_so3(np.pi * 0.98 * UP), np.zeros(3))
    about = se3.transform(np.eye(3), middle) @ turned @ se3.transform(np.eye(3), -middle)
    opposite = replace(rig.cameras[0], name="cam02").with_pose(rig.cameras[0].T_camera_world @ se3.inverse(about))
    pair = Rig((rig.cameras[0], opposite))
    keypoints = simulate_keypoints(walker(), pair, "BODY_25B", seed=4, **ERRORS)
    try:
        result = calibrate_people(tuple(pair), keypoints, BODY, sigma=2.0)
    except CalibrationError as error:
        assert error.remedy
    else:
        assert errors(result.rig, pair)[0] < 1.0


def test_cameras_beside_each_other_alone_are_refused():
    rig = room()
    T = np.array(rig.cameras[0].T_camera_world)
    T[0, 3] += 0.05
    pair = Rig((rig.cameras[0], replace(rig.cameras[0], name="cam02").with_pose(T)))
    keypoints = simulate_keypoints(walker(), pair, "BODY_25B", seed=5, **ERRORS)
    with pytest.raises(CalibrationError, match="differ"):
        calibrate_people(tuple(pair), keypoints, BODY, sigma=2.0)


@pytest.mark.slow
def test_a_camera_beside_another_is_placed_by_the_rest():
    rig = room()
    T = np.array(rig.cameras[0].T_camera_world)
    T[0, 3] += 0.05
    five = Rig((*rig.cameras, replace(rig.cameras[0], name="cam05").with_pose(T)))
    keypoints = simulate_keypoints(walker(), five, "BODY_25B", seed=6, **ERRORS)
    result = calibrate_people(tuple(five), keypoints, BODY, sigma=2.0)
    assert errors(result.rig, five)[0] < 0.15


def test_a_camera_of_another_recording_is_named():
    keypoints = list(seen())
    points = np.random.default_rng(0).uniform(200, 900, keypoints[3].points.shape)
    keypoints[3] = replace(keypoints[3], points=points)
    with pytest.raises(CalibrationError, match="cam04"):
        calibrate_people(tuple(room()), keypoints, BODY, sigma=2.0)


def test_a_camera_that_saw_nobody_is_named():
    keypoints = list(seen())
    blind = np.zeros_like(keypoints[1].confidence)
    keypoints[1] = replace(keypoints[1], points=np.full_like(keypoints[1].points, np.nan), confidence=blind)
    with pytest.raises(CalibrationError, match="cam02"):
        calibrate_people(tuple(room()), keypoints, BODY, sigma=2.0)


@pytest.mark.slow
def test_exchanged_sides_hardly_matter():
    swapped = simulate_keypoints(walker(), room(), "BODY_25B", seed=7, swaps=0.2, **ERRORS)
    result = calibrate_people(tuple(room()), swapped, BODY, sigma=2.0)
    assert errors(result.rig, room())[0] < 0.15


def test_the_same_person_is_kept_among_two():
    record = seen()[0]
    other = record.points + np.array([300.0, 10.0])
    both = np.concatenate([record.points, other], axis=1)
    order = np.random.default_rng(0).permuted(np.tile([0, 1], (len(record), 1)), axis=1)
    points = np.take_along_axis(both, order[:, :, None, None], axis=1)
    confidence = np.concatenate([record.confidence, 0.8 * record.confidence], axis=1)
    confidence = np.take_along_axis(confidence, order[:, :, None], axis=1)
    kept = steady_person(replace(record, points=points, confidence=confidence))
    np.testing.assert_array_equal(kept.points, record.points)


def test_a_first_rig_is_right_up_to_place_turn_and_scale():
    random = np.random.default_rng(0)
    x = walker().positions(BODY.keypoints("BODY_25B")).reshape(-1, 3)[::3]
    uv = np.stack([c.project(x) for c in room()], axis=1) + random.normal(size=(len(x), 4, 2))
    wrong = random.random(uv.shape[:2]) < 0.2
    uv[wrong] += random.uniform(-300, 300, (int(wrong.sum()), 2))
    rig = first_rig(Rig(tuple(c.with_pose(np.eye(4)) for c in room())), uv, 2.0)
    turn, place = errors(rig, room())
    assert turn < 1.0 and place < 60
