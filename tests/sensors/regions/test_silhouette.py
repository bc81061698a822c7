"""Silhouettes as a sensor of the one tracker."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from tests.sensors.scenes import at, posture, ring

from kinefit.bodies import BodyState, load_body
from kinefit.bodies.motion import Motion
from kinefit.bodies.rendering import render_body
from kinefit.errors import ObservationError
from kinefit.exporters import write_motion
from kinefit.fitting.initialization.candidates import LEVELS, coarse_to_fine
from kinefit.fitting.tracking.tracker import Tracker
from kinefit.geometry.camera import Rig
from kinefit.images.silhouette import outline
from kinefit.observations import KeypointFrame, SilhouetteFrame
from kinefit.sensors.regions.silhouette import averaged
from kinefit.sensors.settings import TrackSettings
from kinefit.takes.track import track_take


@pytest.fixture(scope="module")
def body():
    return load_body("humanoid")


@pytest.fixture(scope="module")
def rig():
    return ring()


def silhouettes(body, state, cameras, time, mesh=None):
    return [SilhouetteFrame(c.name, time, render_body(body, state, c, mesh=mesh).seen) for c in cameras]


def tracker(body, rig, **settings):
    return Tracker(body, rig, rate=30.0, up=(0, 1, 0), settings=TrackSettings(search=False, **settings))


def joints(body, state):
    return body.positions(state, body.landmarks)


def test_a_movement_is_followed_by_silhouettes_alone(body, rig):
    follow = tracker(body, rig)
    follow.start_at(posture(body, 0))
    far = []
    for i in range(12):
        truth = posture(body, i)
        result = follow.update(silhouettes(body, truth, rig, i / 30))
        far.append(np.linalg.norm(joints(body, result.state) - joints(body, truth), axis=1))
    assert np.median(far[-4:]) < 0.012 and np.mean(far) < 0.025
    assert result.quality > 0.8 and not result.lost.any()


def test_silhouettes_beside_keypoints(body, rig):
    """One camera's silhouettes and a few keypoints of another: together they see how far away hands are."""
    random = np.random.default_rng(0)
    names = ("l_wrist", "r_wrist", "l_ankle", "nose_tip")
    points = body.landmarks.select(names)
    ends = {}
    for kind in ("silhouettes", "both"):
        follow = tracker(body, rig)
        follow.start_at(posture(body, 0))
        for i in range(8):
            truth = posture(body, 2 * i)
            frames = silhouettes(body, truth, list(rig)[:1], i / 30)
            if kind == "both":
                uv = rig["c3"].project(body.positions(truth, points)) + random.normal(scale=1.0, size=(4, 2))
                frames.append(KeypointFrame("c3", i / 30, names, uv, np.ones(4)))
            state = follow.update(frames).state
        ends[kind] = np.linalg.norm(body.positions(state, points) - body.positions(truth, points), axis=1).mean()
    assert ends["both"] < 0.6 * ends["silhouettes"] and ends["both"] < 0.03


def test_an_empty_mask_lowers_the_quality_and_moves_nothing(body, rig):
    follow, truth = tracker(body, rig), posture(body, 0)
    follow.start_at(truth)
    for i in range(3):
        good = follow.update(silhouettes(body, truth, rig, i / 30))
    empty = [SilhouetteFrame(c.name, 3 / 30, np.zeros(c.size[::-1], np.uint8)) for c in rig]
    result = follow.update(empty)
    assert good.quality > 0.8 and result.quality < 0.05 and result.lost.sum() > 10
    assert np.linalg.norm(joints(body, result.state) - joints(body, good.state), axis=1).max() < 0.05


def test_another_person_apart_changes_nothing_and_one_merged_lowers_the_quality(body, rig):
    truth = posture(body, 2)
    alone = silhouettes(body, truth, rig, 0.0)
    T = np.array(truth.T_world_root)
    T[:3, 3] += (0.0, 0.0, 3.0)
    seen = {}
    for name, shift in (("apart", 3.0), ("merged", 0.35)):
        T[2, 3] = truth.T_world_root[2, 3] + shift
        other = silhouettes(body, BodyState(T, truth.angles), rig, 0.0)
        both = [SilhouetteFrame(a.sensor, 0.0, np.maximum(a.mask, b.mask)) for a, b in zip(alone, other)]
        follow = tracker(body, rig)
        follow.start_at(truth)
        seen[name] = follow.update(both)
    far = {k: np.linalg.norm(joints(body, r.state) - joints(body, truth), axis=1) for k, r in seen.items()}
    assert far["apart"].mean() < 0.015 and seen["apart"].quality > 0.8
    assert seen["merged"].quality < 0.9 * seen["apart"].quality and far["merged"].mean() < 0.1


def test_a_person_who_leaves_the_image_is_held_and_told_as_hidden(body):
    rig = ring(2)
    cut = Rig(tuple(replace(c, matrix=c.matrix + np.array([[0, 0, 0], [0, 0, 150.0], [0, 0, 0]])) for c in rig))
    truth = posture(body, 0)
    follow = tracker(body, cut)
    follow.start_at(truth)
    for i in range(3):
        result = follow.update(silhouettes(body, truth, cut, i / 30))
    feet = [body.tree.segment("foot_r"), body.tree.segment("shank_l")]
    assert result.hidden[feet].all() and not result.hidden[body.tree.segment("head")]
    upper = [k for k, s in enumerate(body.landmarks.segments) if not result.hidden[s]]
    assert np.linalg.norm(joints(body, result.state) - joints(body, truth), axis=1)[upper].mean() < 0.025


def test_a_mask_of_the_wrong_size_is_refused(body, rig):
    follow = tracker(body, rig)
    follow.start_at(posture(body, 0))
    with pytest.raises(ObservationError, match="masks of c0 have"):
        follow.update([SilhouetteFrame("c0", 0.0, np.zeros((10, 10), np.uint8))])
    for wrong in (np.zeros((3, 4, 3), np.uint8), np.zeros((3, 4)), np.zeros((0, 4), np.uint8)):
        with pytest.raises(ObservationError):
            SilhouetteFrame("c0", 0.0, wrong)


def calibration(camera):
    """A camera in the words of a calibration file."""
    T = camera.T_camera_world
    return (
        f'[{camera.name}]\nname = "{camera.name}"\nsize = {[float(n) for n in camera.size]}\n'
        f"matrix = {camera.matrix.tolist()}\ndistortions = [0.0, 0.0, 0.0, 0.0]\n"
        f"rotation = {cv2.Rodrigues(T[:3, :3])[0].ravel().tolist()}\n"
        f"translation = {T[:3, 3].tolist()}\nfisheye = false\n"
    )


def test_the_same_recording_goes_on_from_a_motion_file(body, rig, tmp_path):
    """A take whose only sensor are silhouettes, from the body and pose that `start` tells."""
    truth = [posture(body, i) for i in range(6)]
    for camera in rig:
        folder = tmp_path / camera.name
        folder.mkdir()
        for i, state in enumerate(truth):
            cv2.imwrite(str(folder / f"{i}.png"), silhouettes(body, state, [camera], 0.0)[0].mask)
    (tmp_path / "rig.toml").write_text("".join(map(calibration, rig)))
    count = len(body.tree.segments)
    write_motion(
        Motion(
            body=body, rate=30.0, times=np.zeros(1), Ts_world_root=truth[0].T_world_root[None],
            angles=truth[0].angles[None], dof_std=np.zeros((1, body.tree.n_dofs)), joint_std=np.zeros((1, count, 3)),
            quality=np.ones(1), segment_quality=np.ones((1, count)),
        ),
        tmp_path / "motion.npz",
    )  # fmt: skip
    text = '[take]\nrate = 30.0\nup = "y"\nstart = "motion.npz"\n[calibration]\nfile = "rig.toml"\nunit = "m"\n'
    for camera in rig:
        text += f'[[camera]]\nname = "{camera.name}"\n'
        text += f'[[silhouette]]\ncamera = "{camera.name}"\nfile = "{camera.name}"\nsigma = 2.0\n'
    (tmp_path / "take.toml").write_text(text)
    motion, seen = track_take(tmp_path / "take.toml")
    assert len(motion) == 6 and len(seen.of_kind("silhouette")) == 4
    last = BodyState(motion.Ts_world_root[-1], motion.angles[-1])
    assert np.linalg.norm(joints(motion.body, last) - joints(body, truth[-1]), axis=1).mean() < 0.02
    assert "shape" not in motion.provenance  # the body is the motion's own
    for a, b in zip(motion.body.surfaces, body.surfaces, strict=True):
        np.testing.assert_allclose(a.radii, b.radii)


def test_coarse_to_fine_finds_what_the_finest_level_does_not():
    body, rig = load_body("humanoid10"), ring()
    truth = BodyState(at(body).T_world_root, body.tree.usual)
    seen = silhouettes(body, truth, rig, 0.0)
    swing = np.where(np.arange(len(body.tree.usual)) % 2, 1.0, -1.0)
    far = np.clip(truth.angles + np.radians(40.0) * swing, body.tree.lower, body.tree.upper)
    start = BodyState(truth.T_world_root, far)
    accuracy = {f"silhouette {name}": 1.0 for name in rig.names}
    alone = coarse_to_fine(body, rig, seen, start, sigma=accuracy, levels=LEVELS[-1:])
    found = coarse_to_fine(body, rig, seen, start, sigma=accuracy)
    assert found.overlap > alone.overlap and found.overlap > 0.9
    away = [np.linalg.norm(joints(body, f.result.state) - joints(body, truth), axis=1).mean() for f in (alone, found)]
    assert away[1] < 0.5 * away[0]
    for wrong in ({"levels": ()},):
        with pytest.raises(ObservationError):
            coarse_to_fine(body, rig, seen, start, **wrong)
    with pytest.raises(ObservationError):
        coarse_to_fine(body, rig, [], start)


def test_masks_are_averaged_by_a_whole_factor_first():
    """Close to the area's own average, whatever divides the sizes; the same where a whole factor is all there is."""
    mask = np.zeros((1920, 1088), np.uint8)
    cv2.ellipse(mask, (500, 900), (300, 700), 20.0, 0.0, 360.0, 255, -1)
    for height, width, size in ((1920, 1088, (181, 320)), (1919, 1087, (181, 320)), (480, 640, (320, 240))):
        part = np.ascontiguousarray(mask[:height, :width])
        exact = cv2.resize(part, size, interpolation=cv2.INTER_AREA).astype(int)
        found = averaged(part, size)
        assert found.shape == size[::-1] and np.abs(found - exact).max() <= 40 and np.abs(found - exact).mean() < 0.2
        own, other = (outline(m.astype(np.uint8)) for m in (found, exact))
        away = np.linalg.norm(own[:2, :, None] - other[:2, None], axis=0).min(axis=1)
        assert away.mean() < 0.02 and away.max() < 0.2
