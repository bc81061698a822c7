"""Keypoints simulated from known motions."""

from dataclasses import replace

import numpy as np
import pytest

from kinefit.bodies.motion import ARRAYS, UP_AXES
from kinefit.errors import ExportError, ObservationError
from kinefit.observations.recordings import mirror_name
from kinefit.readers.landmarks.keypoint_sets import KEYPOINT_SETS
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.readers.videos.video import Video
from kinefit.simulation import cut, draw_figure, simulate_keypoints, squat_and_wave, studio_rig, write_synthetic_take

MOTION = squat_and_wave(rate=60.0, duration=4.0)
RIG = studio_rig(MOTION)


def exact(camera, keypoint_set="BODY_25B"):
    return RIG[camera].project(MOTION.positions(MOTION.body.keypoints(keypoint_set)))


def test_the_rig_sees_all_of_the_motion():
    assert RIG.names == ("cam01", "cam02", "cam03", "cam04")
    for camera in RIG:
        assert camera.size == (1088, 1920)
        uv = camera.project(MOTION.positions())
        assert np.all((uv > 0) & (uv < camera.size))
        assert np.median(np.ptp(uv[..., 1], axis=1)) > 500  # px, not from afar
        assert 0.5 < camera.centre_world[2] < 3.0
    places = np.stack([camera.centre_world for camera in RIG])
    views = -places[:, :2] / np.linalg.norm(places[:, :2], axis=1, keepdims=True)
    assert np.abs(np.arccos(np.clip(views @ views.T, -1, 1)))[np.triu_indices(4, 1)].min() > np.radians(40)


@pytest.mark.parametrize("up", ["y", "z", "x", "-y"])
def test_cameras_stand_upright_in_any_world(up):
    for camera in studio_rig(up=up, cameras=3):
        assert camera.T_camera_world[1, :3] @ np.array(UP_AXES[up]) < -0.8  # image rows run down
        assert abs(camera.T_camera_world[0, :3] @ np.array(UP_AXES[up])) < 1e-12
        assert 1.0 < camera.centre_world @ np.array(UP_AXES[up]) < 2.5


@pytest.mark.parametrize("keypoint_set", sorted(set(KEYPOINT_SETS) & set(MOTION.body.keypoint_sets)))
def test_without_errors_points_are_where_they_project(keypoint_set):
    seen = simulate_keypoints(MOTION, RIG, keypoint_set, noise_px=0, outliers=0, missing=0)
    for keypoints in seen:
        points = MOTION.body.keypoints(keypoint_set)
        columns = [keypoints.names.index(name) for name in points.names]
        np.testing.assert_allclose(keypoints.points[:, 0, columns], exact(keypoints.camera, keypoint_set), atol=1e-9)
        lacking = np.delete(keypoints.confidence[:, 0], columns, axis=1)
        assert np.all(lacking == 0) and np.all(keypoints.confidence[:, 0, columns] > 0)


def test_errors_have_the_size_and_share_asked_for():
    for keypoints in simulate_keypoints(MOTION, RIG, noise_px=3.0, outliers=0.1, missing=0.1, seed=4):
        order = [keypoints.names.index(name) for name in MOTION.body.keypoints("BODY_25B").names]
        residual = keypoints.points[:, 0, order] - exact(keypoints.camera)
        size, confidence = np.linalg.norm(residual, axis=-1), keypoints.confidence[:, 0, order]
        seen = np.isfinite(size)
        assert np.array_equal(seen, confidence > 0)
        assert abs(1 - seen.mean() - 0.1) < 0.015
        far = size > 15
        assert 0.07 < far[seen].mean() < 0.115
        assert abs(np.std(residual[seen & ~far]) - 3.0) < 0.2
        assert np.mean(confidence[far]) < np.mean(confidence[seen & ~far]) - 0.1
        assert np.max(confidence[far]) > np.median(confidence[seen & ~far])  # some outliers look trustworthy


def test_drift_lasts_and_jitter_does_not():
    still = cut(MOTION, 0, 1)
    still = replace(
        still, times=np.arange(3000) / 60.0,
        **{n: np.repeat(getattr(still, n), 3000, axis=0) for n in ARRAYS if n != "times"},
    )
    one = RIG.select(("cam01",))
    (seen,) = simulate_keypoints(still, one, noise_px=0, drift_px=4, drift_time=0.2, outliers=0, missing=0)
    errors = (seen.points[:, 0] - exact("cam01")[0])[:, np.isfinite(seen.points[0, 0, :, 0])]
    assert errors.std() == pytest.approx(4.0, rel=0.1)
    for lag in (1, 12, 60):
        together = np.mean(errors[lag:] * errors[:-lag]) / np.mean(errors**2)
        assert together == pytest.approx(np.exp(-lag / 12.0), abs=0.08)


def test_the_seed_decides():
    a, b, c = (simulate_keypoints(MOTION, RIG, swaps=0.1, seed=seed)[2] for seed in (1, 1, 2))
    np.testing.assert_array_equal(a.points, b.points)
    np.testing.assert_array_equal(a.confidence, b.confidence)
    assert not np.array_equal(a.points, c.points, equal_nan=True)


def test_swaps_come_in_bursts():
    clean = simulate_keypoints(MOTION, RIG, noise_px=0, outliers=0, missing=0)
    seen = simulate_keypoints(MOTION, RIG, noise_px=0, outliers=0, missing=0, swaps=0.2, seed=3)
    for k, keypoints in enumerate(seen):
        left, right = keypoints.names.index("LKnee"), keypoints.names.index("RKnee")
        swapped = np.all(keypoints.points[:, 0, left] == clean[k].points[:, 0, right], axis=1)
        assert swapped.sum() == round(0.2 * len(MOTION))
        assert np.count_nonzero(np.diff(swapped.astype(int))) < 0.5 * swapped.sum()
        np.testing.assert_array_equal(keypoints.points[~swapped], clean[k].points[~swapped])


@pytest.mark.parametrize("keypoint_set", sorted(KEYPOINT_SETS))
def test_the_mirror_of_a_mirror_is_the_point_itself(keypoint_set):
    names = KEYPOINT_SETS[keypoint_set]
    pairs = {name: mirror_name(name) for name in names}
    assert all(pairs[other] == name for name, other in pairs.items())
    assert len(names) - sum(name == other for name, other in pairs.items()) >= 16


def test_a_bystander_comes_in_any_order():
    bystander = cut(MOTION, 30, 130)
    for keypoints in simulate_keypoints(MOTION, RIG, noise_px=0, outliers=0, missing=0, bystander=bystander):
        nose = exact(keypoints.camera)[:, MOTION.body.keypoints("BODY_25B").index("Nose")]
        found = np.all(np.abs(keypoints.points[:, :, keypoints.names.index("Nose")] - nose[:, None]) < 1e-9, axis=-1)
        assert np.all(found.any(axis=1)) and 0.3 < found[:, 0].mean() < 0.7
        people = (keypoints.confidence.sum(axis=2) > 0).sum(axis=1)
        assert np.all(people == np.where(np.arange(len(MOTION)) < 100, 2, 1))


WRONG = [{"outliers": 1.5}, {"missing": -0.1}, {"noise_px": float("nan")}, {"keypoint_set": "X"}]


@pytest.mark.parametrize("wrong", WRONG)
def test_wrong_requests_are_told(wrong):
    with pytest.raises(ObservationError):
        simulate_keypoints(MOTION, RIG, **wrong)
    with pytest.raises(ObservationError, match="cameras"):
        studio_rig(cameras=0)
    with pytest.raises(ObservationError, match="from which camera 1 sees all of the motion"):
        studio_rig(MOTION, focal=50_000.0)


def test_the_squat_stands_on_the_floor_and_keeps_the_limits():
    body = MOTION.body
    assert np.all((MOTION.angles > body.tree.lower - 1e-12) & (MOTION.angles < body.tree.upper + 1e-12))
    feet = MOTION.positions(body.landmarks.select(("l_heel", "r_heel", "l_digit_2", "r_digit_2")))
    assert np.abs(feet[..., 2]).max() < 0.03
    assert np.ptp(MOTION.Ts_world_root[:, 2, 3]) > 0.25
    assert np.abs(np.diff(MOTION.angles, axis=0)).max() < np.radians(10)


def test_the_figure_covers_the_joints():
    camera = RIG["cam01"].scaled((272, 480))
    picture = draw_figure(MOTION, 100, camera)
    assert picture.shape == (480, 272, 3) and picture.dtype == np.uint8
    drawn = np.any(picture != 128, axis=-1)
    uv = np.round(camera.project(MOTION.segment_poses()[100, :, :3, 3])).astype(int)
    assert np.all(drawn[uv[:, 1], uv[:, 0]]) and 0.01 < drawn.mean() < 0.2
    background = np.zeros((480, 272, 3), np.uint8)
    upon = draw_figure(MOTION, 100, camera, background)
    assert np.mean(upon[~drawn] == 0) > 0.999 and upon[~drawn].max() < 64  # but for the last trace of a soft edge
    assert not background.any()


def test_the_synthetic_take_can_be_read(tmp_path):
    path = write_synthetic_take(tmp_path / "take", seed=5)
    observations = load_observations(read_take(path))
    assert path.name == "take.toml" and not list(path.parent.glob(".writing*"))
    truth, rig = squat_and_wave(), observations.rig
    for keypoints in observations.keypoints:
        points = truth.body.keypoints("MEDIAPIPE_33")
        expected = rig[keypoints.camera].project(truth.positions(points))
        order = [keypoints.names.index(name) for name in points.names]
        assert np.nanmedian(np.linalg.norm(keypoints.points[:, 0, order] - expected, axis=-1)) < 2.5
    with Video(path.parent / "cam02.mp4") as video:
        assert (len(video), video.rate, video.size) == (60, 30.0, (544, 960))


def test_a_synthetic_take_of_another_motion_has_wide_images_where_it_goes_far(tmp_path):
    walk = cut(squat_and_wave(), 0, 3)
    Ts = np.array(walk.Ts_world_root)
    Ts[:, 0, 3] += (0.0, 2.0, 4.0)
    for name, motion, size in (("on the spot", walk, (544, 960)), ("far", replace(walk, Ts_world_root=Ts), (960, 544))):
        observations = load_observations(read_take(write_synthetic_take(tmp_path / name, motion)))
        assert observations.rig["cam01"].size == size and len(observations.keypoints[0].points) == 3


def test_a_folder_that_cannot_be_written_is_told(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ExportError, match="cannot be written"):
        write_synthetic_take(tmp_path / "file" / "take")
