"""Flat pictures: every pixel shows what the camera saw in its direction, whatever became of the picture."""

import cv2
import numpy as np
import pytest
from tests.exporters.synthetic import a_camera
from tests.studio.viewers.recordings import write_video

from kinefit.errors import FileError
from kinefit.geometry.camera import Camera, ImageFrame
from kinefit.geometry.lines import triangulate_robust
from kinefit.readers.calibration.read import read_calibration
from kinefit.readers.landmarks.keypoints import read_keypoints
from kinefit.readers.videos.video import Video
from kinefit.studio import viewers
from kinefit.studio.viewers.stage import CameraImages, first_look, fitting_fov, flat_view, flatten, undistortion

SIZE = (320, 480)


def fisheye(focal=260.0):
    K = np.array([[focal, 0, 170], [0, focal, 230], [0, 0, 1]])
    return Camera("f", SIZE, K, [0.02, -0.01, 0.001, 0.0], "fisheye", a_camera("f", 0.4).T_camera_world)


def off_centre():
    camera = a_camera("o", 0.3)
    K = camera.matrix + [[0, 0, 45], [0, 0, -60], [0, 0, 0]]
    return Camera("o", SIZE, K, [-0.25, 0.08, 0.001, -0.002], T_camera_world=camera.T_camera_world)


def frames():
    return {
        "as it is": (ImageFrame.identity(), SIZE), "scaled": (ImageFrame.scaled(SIZE, (200, 300)), (200, 300)),
        "boxed": (ImageFrame.letterboxed(SIZE, (400, 480)), (400, 480)),
        "turned": (ImageFrame.rotated(SIZE, 90), (480, 320)),
    }  # fmt: skip


@pytest.mark.parametrize("camera", [a_camera("a", 0.2), off_centre(), fisheye()], ids=lambda c: c.name)
@pytest.mark.parametrize("frame", frames())
def test_a_spot_is_seen_where_its_point_is(camera, frame):
    image, (w, h) = frames()[frame]
    view = flat_view(camera, 400)
    pixels = undistortion(camera, image, view)
    rng, found = np.random.default_rng(0), 0
    for x_camera in rng.uniform((-0.5, -0.8, 2), (0.5, 0.8, 3), (6, 3)):
        x_world = camera.T_world_camera[:3, :3] @ x_camera + camera.T_world_camera[:3, 3]
        u, v = image.from_calibration(camera.project(x_world))
        if not (6 < u < w - 7 and 6 < v < h - 7):
            continue
        found += 1
        yy, xx = np.mgrid[:h, :w]
        spot = (255 * np.exp(-((xx - u) ** 2 + (yy - v) ** 2) / 8)).astype(np.uint8)
        flat = flatten(np.repeat(spot[..., None], 3, axis=2), pixels)[..., 0].astype(float)
        flat[flat < 60] = 0
        yy, xx = np.mgrid[: flat.shape[0], : flat.shape[1]]
        centre = np.array([np.sum(xx * flat), np.sum(yy * flat)]) / flat.sum()
        assert np.abs(centre - view.pixels(x_camera)).max() < 0.6
    assert found >= 3


@pytest.mark.parametrize("camera", [a_camera("a", 0.2), off_centre(), fisheye()], ids=lambda c: c.name)
def test_the_view_holds_the_whole_image_and_its_axis_is_the_cameras(camera):
    view = flat_view(camera, 300)
    assert max(view.size) == 300 and view.aspect == pytest.approx(view.size[0] / view.size[1], rel=0.01)
    corners = np.array([(0, 0), (SIZE[0] - 1, 0), (0, SIZE[1] - 1), (SIZE[0] - 1, SIZE[1] - 1)], float)
    x = camera.with_pose(np.eye(4)).ray(corners)
    uv = view.pixels(x)
    assert np.all(uv > -2) and np.all(uv < np.array(view.size) + 1)
    assert np.allclose(view.pixels(np.array([0, 0, 1.0])), (np.array(view.size) - 1) / 2)
    assert np.allclose(view.pixels(view.rays()), np.stack(np.meshgrid(*map(np.arange, view.size)), -1))


def test_a_window_of_any_shape_holds_the_view():
    for tangents in ((0.3, 0.6), (0.9, 0.4)):
        for aspect in (0.4, 1.0, 2.5):
            half = np.tan(fitting_fov(tangents, aspect) / 2)
            assert half >= tangents[1] - 1e-12 and half * aspect >= tangents[0] - 1e-12
            assert half == pytest.approx(tangents[1]) or half * aspect == pytest.approx(tangents[0])


@pytest.mark.parametrize("vertical", [(0, 0, 1.0), (0, 1.0, 0), (0, 0, -1.0)])
def test_the_first_look_comes_from_above_between_the_cameras(vertical):
    vertical = np.array(vertical)
    side = np.roll(vertical, 1)
    cameras = np.array([side, np.cross(vertical, side), side + np.cross(vertical, side)]) * 4 + 0.8 * vertical
    eye = first_look(cameras, vertical)
    assert np.linalg.norm(eye) == pytest.approx(1) and eye @ vertical > 0.2
    assert np.all(cameras @ eye < 1)
    assert first_look(np.zeros((0, 3)), vertical) @ vertical > 0.2


def test_a_very_wide_lens_is_shown_without_its_rim():
    view = flat_view(fisheye(focal=100.0), 300)
    assert np.degrees(np.arctan(view.tangents)).max() == pytest.approx(65)
    assert np.isfinite(undistortion(fisheye(focal=100.0), ImageFrame.identity(), view)[150, 150]).all()


def test_pictures_are_the_videos_at_their_time_and_are_kept(tmp_path, monkeypatch):
    path = write_video(tmp_path / "a.mkv", 10)
    with Video(path) as video:
        w, h = video.size
        K = np.array([[150.0, 0, (w - 1) / 2], [0, 150.0, (h - 1) / 2], [0, 0, 1]])
        pictures = CameraImages({"a": Camera("a", (w, h), K)}, {"a": path}, time_offsets={"a": 0.5})
        assert "a" in pictures and "b" not in pictures
        found = pictures.read("a", 0.5 + 7 / video.rate, 128)
        assert found.shape == (h, w, 3)
        assert np.abs(found.astype(int) - video.read(7)).mean() < 1.0  # no distortion: the very picture
        assert pictures.read("a", 0.5 + 7 / video.rate, 128) is found
        assert pictures.read("a", 0.4, 128) is None and pictures.read("a", 1e3, 128) is None
        assert pictures.read("b", 0.5, 128) is None
        monkeypatch.setattr("kinefit.studio.viewers.stage._MAX_CACHE_BYTES", 2 * found.nbytes)
        for i in range(4):
            pictures.read("a", 0.5 + i / video.rate, 128)
        assert len(pictures._kept) == 2
        pictures.close()


def test_a_missing_video_is_told(tmp_path):
    with pytest.raises(FileError, match="no such video"):
        CameraImages({"a": a_camera("a", 0)}, {"a": tmp_path / "none.mp4"})


def test_points_of_a_real_person_are_on_the_person_in_every_flat_picture(data_dir):
    folder = data_dir("video_balancing_4cam")
    cameras = [f"cam0{c}" for c in range(1, 5)]  # the videos of the first two are scaled and letterboxed
    frame, names = 40, ["left_shoulder", "right_shoulder", "left_hip", "right_hip", "left_knee", "right_knee"]
    rig = read_calibration(folder / "Calib_refined_static.toml", unit="m").select(tuple(cameras))
    seen, images = [], {}
    for camera in cameras:
        with Video(folder / "videos" / f"{camera}.mp4") as video:
            images[camera] = ImageFrame.letterboxed(rig[camera].size, video.size)
        file = folder / f"mediapipe_landmarks_{camera}.npy"
        keypoints = read_keypoints(file, format="mediapipe", camera=camera, rate=60.0, image_frame=images[camera])
        seen.append(keypoints.points[frame, 0, [keypoints.names.index(n) for n in names]])
    x, inliers, _ = triangulate_robust(rig, np.stack(seen, axis=1), max_residual_px=40.0)
    assert inliers.sum() >= 20
    for camera in rig:
        view = flat_view(camera, 480)
        mask = cv2.imread(str(folder / "person_masks" / camera.name / f"{frame:03d}.png"))
        flat = flatten(mask, undistortion(camera, images[camera.name], view))
        uv = np.rint(view.pixels(x @ camera.T_camera_world[:3, :3].T + camera.T_camera_world[:3, 3])).astype(int)
        on = flat[uv[:, 1], uv[:, 0], 0] > 128
        assert on.mean() >= 5 / 6, camera.name


@pytest.mark.parametrize(("old", "new"), [("Recording", "ViewerContent"), ("Pictures", "CameraImages")])
def test_an_old_name_is_the_new_one_with_a_warning_that_names_it(old, new):
    with pytest.warns(FutureWarning, match=f"{old} is {new} now"):
        assert getattr(viewers, old) is getattr(viewers, new)
