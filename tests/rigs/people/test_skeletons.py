"""First cameras from landmarks that a network lifted: turns, clocks and whom they saw, with no lens known."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from tests.rigs.people_data import BODY, room, walker

from kinefit.errors import CalibrationError
from kinefit.geometry import se3
from kinefit.rigs.people.calibrate import calibrate_people
from kinefit.rigs.people.skeletons import first_cameras, in_step
from kinefit.rigs.refine.refine import check_result
from kinefit.rigs.refine.result import CameraChange
from kinefit.simulation import simulate_keypoints

FRAMES = 90
LATE = (0, 7, -4, 2)  # frames
POINTS = BODY.keypoints("MEDIAPIPE_33")


def lifted(record, camera, x, seed):
    """The record of one person with landmarks about the hips in the camera's axes: turned by 6 degrees, 2 cm off."""
    random = np.random.default_rng(seed)
    own = se3.apply(camera.T_camera_world, x)
    own = own - own[:, [POINTS.names.index("left_hip"), POINTS.names.index("right_hip")]].mean(axis=1, keepdims=True)
    axis = random.normal(size=3)
    own = own @ se3.exp_so3(np.radians(6.0) * axis / np.linalg.norm(axis)) + random.normal(0.0, 0.02, own.shape)
    whole = np.full((*record.points.shape[:3], 3), np.nan)
    whole[:, 0, [record.names.index(name) for name in POINTS.names]] = own
    return replace(record, lifted=whole)


@cache
def seen(late=(0, 0, 0, 0)):
    """What four cameras saw of the walker; camera c shows at its frame f what happened at f + late[c]."""
    motion = walker(FRAMES)
    records = simulate_keypoints(motion, room(), "MEDIAPIPE_33", seed=2, noise_px=2.0, outliers=0.02, missing=0.02)
    x = motion.positions(POINTS)
    whole = [lifted(r, c, x, k) for k, (r, c) in enumerate(zip(records, room(), strict=True))]
    return tuple(in_step(record, -frames, FRAMES) for record, frames in zip(whole, late, strict=True))


def guessed():
    """The cameras with lenses a tenth too long, standing nowhere."""
    scale = np.array([[1.1, 1, 1], [1, 1.1, 1], [1, 1, 1]])
    return tuple(replace(c, matrix=c.matrix * scale).with_pose(np.eye(4)) for c in room())


def turn_errors(rig):
    out = []
    for a, b in zip(room().names, room().names[1:]):
        R, Q = (r[b].T_camera_world[:3, :3] @ r[a].T_camera_world[:3, :3].T for r in (rig, room()))
        out.append(np.degrees(np.linalg.norm(se3.log_so3(R.T @ Q))))
    return np.array(out)


def test_turns_and_clocks_come_from_skeletons_alone():
    found = first_cameras(guessed(), seen(LATE), within=1.0)
    np.testing.assert_allclose(found.frames_late, LATE, atol=1)
    assert turn_errors(found.rig).max() < 20.0
    x = np.array([c.to_camera(np.zeros(3)) if hasattr(c, "to_camera") else c.T_camera_world[:3, 3] for c in found.rig])
    assert np.isfinite(x).all()


def test_in_step_clocks_are_left_alone_where_they_are_known():
    found = first_cameras(guessed(), seen(LATE), within=0.0)
    assert not found.frames_late.any()


def test_lenses_clocks_and_poses_are_found_together():
    found = calibrate_people(
        guessed(), seen(LATE), BODY, sigma=2.0, height=BODY.stature, focal=True, time_offsets=True, up="z"
    )
    assert turn_errors(found.rig).max() < 0.6
    for a, b in zip(found.rig, room(), strict=True):
        assert a.matrix[0, 0] == pytest.approx(b.matrix[0, 0], rel=0.02)
    np.testing.assert_allclose(np.array(list(found.time_offsets.values())) * 30.0, LATE, atol=0.2)


def test_the_same_person_is_found_among_two():
    """In each camera another one comes first, and the second does something else."""
    both = []
    for k, record in enumerate(seen()):
        other = in_step(record, 25, FRAMES)
        order = [0, 1] if k % 2 else [1, 0]
        arrays = {
            what: np.concatenate([getattr(record, what), getattr(other, what)], axis=1)[:, order]
            for what in ("points", "confidence", "lifted")
        }
        arrays["points"] = arrays["points"] + np.array([0.0, 400.0])[np.array(order)][None, :, None, None]
        both.append(replace(record, **arrays))
    found = first_cameras(guessed(), both, within=0.0)
    assert turn_errors(found.rig).max() < 20.0
    firsts = [np.nanmedian(p.points[:, 0] - r.points[:, 0]) for p, r in zip(found.people, seen(), strict=True)]
    assert np.ptp(firsts) < 100.0  # all of one person: moved aside by 400 px in all cameras, or in none


def test_one_video_twice_is_refused():
    one = seen()
    twice = (one[0], replace(one[0], camera="cam02"), *one[2:])
    with pytest.raises(CalibrationError, match="cam02.*one video twice|same images"):
        first_cameras(guessed(), twice, within=0.0)


def test_a_camera_of_another_day_is_named():
    """One that shows the same person backwards."""
    one = list(seen())
    turned = {what: getattr(one[3], what)[::-1] for what in ("points", "confidence", "lifted")}
    one[3] = replace(one[3], **turned)
    with pytest.raises(CalibrationError, match="cam04"):
        calibrate_people(guessed(), one, BODY, sigma=2.0, focal=True, time_offsets=True, up="z")


def test_a_motion_that_tells_no_lens_is_refused():
    still = CameraChange(5.0, 5.0, np.zeros(2), 0.1, 0.1, 0.2, 0.0, 0.02, 0.1, 0.3, 0.0, 20.0)
    changes = dict.fromkeys(room().names, still)
    with pytest.raises(CalibrationError, match="does not determine the lenses.*cam01 to 30 %.*walks"):
        check_result(room(), changes, 0.2, times=10.0)


def test_somebody_who_stands_still_tells_nothing_of_clocks():
    still = [replace(r, **{w: np.repeat(getattr(r, w)[:1], 30, axis=0) for w in ("points", "confidence", "lifted")})
             for r in seen()]
    with pytest.raises(CalibrationError, match="move like no people.*person who moves"):
        first_cameras(guessed(), still, within=1.0)


def test_frames_are_moved_whole():
    record = seen()[0]
    moved = in_step(record, 3, FRAMES)
    np.testing.assert_array_equal(moved.points[3:], record.points[:-3])
    assert np.isnan(moved.points[:3]).all() and not moved.confidence[:3].any() and np.isnan(moved.lifted[:3]).all()
