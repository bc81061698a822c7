"""Overlays show the fit where the camera sees it."""

from dataclasses import replace

import av
import cv2
import numpy as np
import pytest
from tests.exporters.synthetic import a_camera, smooth_motion

from kinefit.bodies import load_body
from kinefit.bodies.limbs import finger_groups
from kinefit.bodies.rendering.looks import CENTRE_COLOUR, LEFT_COLOUR, LOST_COLOUR, RIGHT_COLOUR
from kinefit.errors import ExportError
from kinefit.exporters import draw_overlay, write_montage, write_overlay
from kinefit.exporters.pictures.drawing import bones
from kinefit.exporters.pictures.overlay import frames_of
from kinefit.geometry.camera import ImageFrame
from kinefit.readers.videos.video import Video
from kinefit.simulation import cut

CAMERA = a_camera("cam 0", 0.3)
GREY = np.full((480, 320, 3), 90, np.uint8)


@pytest.fixture(scope="module")
def motion():
    motion = smooth_motion(12, turns=0.1)
    still = np.zeros_like(motion.angles)
    return replace(motion, angles=still, segment_quality=np.ones_like(motion.segment_quality))


def a_video(path, size, frames):
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=60)
        (stream.width, stream.height), stream.pix_fmt = size, "bgr0"
        for i in range(frames):
            image = np.full((size[1], size[0], 3), 60 + i, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24").reformat(format="bgr0")))
        container.mux(stream.encode(None))
    return path


def at(image, uv):
    u, v = np.rint(uv).astype(int)
    return image[v, u].astype(int)


def test_bones_lie_where_the_camera_sees_them_in_the_colour_of_their_side(motion):
    image = draw_overlay(GREY, replace(motion, residuals={}), 3, CAMERA)
    body = motion.body
    cases = {
        ("r_hip", "r_knee"): RIGHT_COLOUR, ("l_elbow", "l_wrist"): LEFT_COLOUR,
        ("sacroiliac", "hip_centre"): CENTRE_COLOUR,
    }  # fmt: skip
    for names, colour in cases.items():
        a, b = CAMERA.project(motion.positions(body.landmarks.select(names))[3])
        assert np.abs(at(image, 0.5 * a + 0.5 * b) - colour).max() < 25, names
    assert (GREY == 90).all()


def test_bones_reach_from_joint_to_joint_and_to_the_ends(motion):
    points, owners, colours, widths = bones(motion.body)
    assert len(points) == 2 * len(owners) == 2 * len(colours) == 2 * len(widths)
    leaves = [s for s in range(20) if not np.any(motion.body.tree.parents == s)]
    assert len(owners) == 19 + len(leaves)
    assert list(owners) == sorted(owners)
    assert set(widths) == {0.022}


def test_bones_of_fingers_are_thinner_than_those_of_arms():
    body = load_body("humanoid_hands")
    _, owners, _, widths = bones(body)
    thin = [body.tree.segments[s] for s, width in zip(owners, widths) if width < 0.01]
    assert set(thin) == {"hand_l", "hand_r", *(s for own in finger_groups(body).values() for s in own)}
    assert len(thin) == 2 * 5 * 4  # of each hand and digit, to the knuckle and its three bones


def test_a_lens_bends_bones_and_other_pictures_are_met(motion):
    frame = ImageFrame.letterboxed(CAMERA.size, (400, 500))
    grey = np.full((500, 400, 3), 90, np.uint8)
    image = draw_overlay(grey, replace(motion, residuals={}), 0, CAMERA, image_frame=frame)
    a, b = motion.positions(motion.body.landmarks.select(("r_knee", "r_ankle")))[0]
    assert np.abs(at(image, frame.from_calibration(CAMERA.project(0.5 * (a + b)))) - RIGHT_COLOUR).max() < 25


def test_lost_segments_turn_grey_and_are_named(motion, monkeypatch):
    told = []
    put = cv2.putText
    monkeypatch.setattr(cv2, "putText", lambda image, text, *a: told.append(text) or put(image, text, *a))
    quality = np.array(motion.segment_quality)
    quality[3, motion.body.tree.segment("thigh_r")] = 0
    draw_overlay(GREY, replace(motion, segment_quality=quality), 3, CAMERA)
    draw_overlay(GREY, motion, None, CAMERA, label="frame 99")
    swapped = replace(motion.residuals["cam 0"], swapped=np.ones(12, bool), weights=np.zeros((12, 25)))
    draw_overlay(GREY, replace(motion, quality=np.zeros(12)), 5, CAMERA, residuals=swapped)
    norms = motion.residuals["cam 0"].norms[3]
    assert told[0] == "cam 0   frame 3"
    assert f"median {np.nanmedian(norms):.1f}, mean {np.nanmean(norms):.1f} px" in told[1]
    assert told[2] == "lost: thigh_r"
    assert told[3:5] == ["cam 0   frame 99", "no motion here"]
    assert "0 points" in told[6] and "rejected" in told[6] and "corrected" in told[7] and told[8] == "not tracked"


def test_the_skin_covers_the_body_shaded_and_lost_or_uncertain_parts_less(motion):
    motion, tree = replace(motion, residuals={}), motion.body.tree
    small = ImageFrame.scaled(CAMERA.size, (160, 240))
    quality, std = np.array(motion.segment_quality), np.full_like(motion.joint_std, 0.01)
    quality[3, tree.segment("thigh_r")], std[3, tree.segment("hand_l")] = 0, 0.2
    told = replace(motion, segment_quality=quality, joint_std=std)
    knee, hip, elbow, wrist = CAMERA.project(
        motion.positions(motion.body.landmarks.select(("r_knee", "r_hip", "l_elbow", "l_wrist")))[3]
    )
    plain, skin = draw_overlay(GREY, told, 3, CAMERA), draw_overlay(GREY, told, 3, CAMERA, skin=True)
    covered = (plain != skin).any(axis=2)
    bones = (plain != 90).any(axis=2)[70:]  # below the label
    assert 0.5 * bones.sum() < covered.sum() < 0.3 * covered.size
    image = skin.astype(int)
    sure = draw_overlay(GREY, replace(motion, joint_std=0 * std), 3, CAMERA, skin=True).astype(int)
    thigh = beside(0.5 * (knee + hip), knee - hip, covered & ~(plain != 90).any(axis=2))
    assert np.ptp(image[thigh]) <= 2 and sure[thigh][0] > sure[thigh][1] + 40 > sure[thigh][2] + 40  # grey, not orange
    hand = np.rint(1.2 * wrist - 0.2 * elbow).astype(int)
    arm = np.s_[hand[1] - 12 : hand[1] + 12, hand[0] - 12 : hand[0] + 12]
    changed = (image[arm] != sure[arm]).any(axis=2)
    blue, before = (np.mean((view[..., 2] - view[..., 0])[arm][changed]) for view in (image, sure))
    assert changed.sum() > 10 and 20 < blue < before - 5
    half = draw_overlay(GREY[::2, ::2], told, 3, CAMERA, image_frame=small, skin=True)
    assert np.abs(half[120:] - cv2.resize(skin, (160, 240), interpolation=cv2.INTER_AREA)[120:].astype(int)).mean() < 6
    bare = replace(motion, body=replace(motion.body, surfaces=()))
    assert np.array_equal(draw_overlay(GREY, bare, 3, CAMERA), draw_overlay(GREY, bare, 3, CAMERA, skin=True))


def beside(middle, along, free):
    """(row, column) of the nearest free pixel at right angles to a bone."""
    across = np.array([-along[1], along[0]]) / np.linalg.norm(along)
    for k in range(1, 30):
        for side in (k, -k):
            u, v = np.rint(middle + side * across).astype(int)
            if free[v, u]:
                return v, u
    raise AssertionError("the bone has no skin")


def test_a_lost_bone_is_dashed_and_grey(motion):
    thigh = motion.body.tree.segment("thigh_r")
    quality = np.array(motion.segment_quality)
    quality[3, thigh] = 0
    a, b = CAMERA.project(motion.positions(motion.body.landmarks.select(("r_hip", "r_knee")))[3])
    along = np.linspace(0.1, 0.9, 200)[:, None] * (b - a) + a
    for values, share in ((motion.segment_quality, 0.0), (quality, 0.2)):
        image = draw_overlay(GREY, replace(motion, residuals={}, segment_quality=values), 3, CAMERA)
        shades = np.array([at(image, uv) for uv in along])
        dashes, gaps = (np.abs(shades - colour).max(axis=1) < 25 for colour in (LOST_COLOUR, GREY[0, 0]))
        assert dashes.mean() >= share and gaps.mean() >= share
        assert dashes.any() == gaps.any() == (share > 0)
        assert (np.abs(shades - RIGHT_COLOUR).max(axis=1) < 25).mean() == (share == 0)


def test_keypoints_are_rings_and_outliers_crosses(motion):
    r = motion.residuals["cam 0"]
    far = np.full_like(r.measured, np.nan)
    far[:, 0], far[:, 1] = (40, 400), (280, 400)
    weights = np.ones_like(r.weights)
    weights[:, 1] = 0
    r = replace(r, measured=far, values=np.zeros_like(far), weights=weights)
    image = draw_overlay(GREY, motion, 0, CAMERA, residuals=r)
    ring, cross = image[390:411, 30:51].reshape(-1, 3).astype(int), image[390:411, 270:291].reshape(-1, 3).astype(int)
    assert ((ring[:, 0] > 180) & (ring[:, 1] > 180) & (ring[:, 2] < 140)).any()  # yellow
    assert ((cross[:, 0] > 180) & (cross[:, 1] < 110)).any()  # red
    assert not ((cross[:, 0] > 180) & (cross[:, 1] > 180)).any()


def test_points_behind_the_camera_and_far_away_are_left_out(motion):
    behind = CAMERA.with_pose(np.diag([-1.0, 1, -1, 1]) @ CAMERA.T_camera_world)
    image = draw_overlay(GREY, replace(motion, residuals={}), 0, behind)
    assert (image[100:] == 90).all()


@pytest.mark.parametrize("size", [(320, 480), (321, 481)])
def test_every_picture_is_in_the_video(tmp_path, motion, size):
    path = a_video(tmp_path / "in.mkv", size, 10)
    done = []
    with Video(path) as video:
        write_overlay(motion, CAMERA, video, tmp_path / "out.mp4", time_offset=2.0, progress=done.append)
    assert done == list(range(1, 11))
    with Video(tmp_path / "out.mp4") as out:
        assert len(out) == 10 and out.size == (320, 480) and out.rate == pytest.approx(60)
        for i in (0, 9):
            image = out.read(i).astype(int)
            assert np.abs(image[-20:, :40] - (60 + i)).mean() < 8
            a, b = CAMERA.project(motion.positions(motion.body.landmarks.select(("r_hip", "r_knee")))[i])
            patch = at(image, 0.5 * (a + b))
            assert patch[0] > patch[2] + 40  # orange
    assert sorted(p.name for p in tmp_path.iterdir()) == ["in.mkv", "out.mp4"]


def test_an_overlay_has_the_times_of_its_video(tmp_path, motion):
    times = (2.0 + np.array([0, 1, 2, 4, 6, 8, 9])) / 60
    with Video(a_video(tmp_path / "in.mkv", (320, 480), 7)) as video:
        video.times = times - times[0]
        write_overlay(motion, CAMERA, video, tmp_path / "out.mp4", time_offset=2.0)
    with Video(tmp_path / "out.mp4") as out:
        np.testing.assert_allclose(out.times, times - times[0], atol=1e-4)
        a, b = CAMERA.project(motion.positions(motion.body.landmarks.select(("r_hip", "r_knee")))[8])
        patch = at(out.read(5).astype(int), 0.5 * (a + b))  # shown at step 8
        assert patch[0] > patch[2] + 40


def test_only_the_motion_s_pictures_are_drawn(tmp_path, motion):
    path, done = a_video(tmp_path / "in.mkv", (320, 480), 20), []
    part = cut(motion, 0, 4)
    part = replace(part, times=2.0 + (6 + np.arange(4)) / 60)
    with Video(path) as video:
        write_overlay(part, CAMERA, video, tmp_path / "out.mp4", time_offset=2.0, progress=done.append)
    assert done == [1, 2, 3, 4]
    with Video(tmp_path / "out.mp4") as out:
        assert len(out) == 4
        assert np.abs(out.read(0).astype(int)[-20:, :40] - (60 + 6)).mean() < 8
    assert frames_of(part, 2.0 + np.arange(20) / 60) == range(6, 10)
    assert frames_of(part, np.arange(100.0, 120.0)) == range(20)  # none: all, each with a note


def test_frames_are_matched_by_time(motion):
    assert motion.frame_at(2.0) == 0 and motion.frame_at(2.0 + 3.4 / 60) == 3
    assert motion.frame_at(1.9) is None and motion.frame_at(3.0) is None
    assert smooth_motion(0).frame_at(0.0) is None


def test_montage_puts_pictures_side_by_side(tmp_path):
    images = {"a": np.full((40, 20, 3), (255, 0, 0), np.uint8), "b": np.full((80, 60, 3), (0, 0, 255), np.uint8)}
    write_montage(images, tmp_path / "a.png", height=80, gap=10)
    back = cv2.imread(str(tmp_path / "a.png"))[..., ::-1]
    assert back.shape == (80, 40 + 10 + 60, 3)
    assert (back[5, 5] == (255, 0, 0)).all() and (back[5, 45] == 255).all() and (back[5, 100] == (0, 0, 255)).all()
    with pytest.raises(ExportError, match="no images"):
        write_montage({}, tmp_path / "b.png")
