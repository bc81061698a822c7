"""Heads of everybody are found: near and far, in true pictures; the parts of an image leave nothing out."""

import numpy as np
import pytest

from kinefit.errors import AssetError
from kinefit.images.detectors.faces import FaceDetector, head_circles, parts
from kinefit.readers import assets
from kinefit.readers.videos.video import Video


@pytest.mark.parametrize("size", [(1920, 1080), (1080, 1920), (640, 480), (300, 200), (3840, 2160)])
def test_parts_cover_the_image_and_stay_in_it(size):
    found = parts(*size, small=True)
    assert found[0] == (0, 0, max(size)) and {*parts(*size, small=False)} < {*found}
    for wanted in {side for *_, side in found[1:]}:
        covered = np.zeros(size[::-1], int)
        for u, v, side in found[1:]:
            if side == wanted:
                assert covered[v : v + side, u : u + side].shape == (side, side)
                covered[v : v + side, u : u + side] += 1
        assert covered.min() >= 1
    assert min(side for *_, side in found) in range(100, 500)


def test_a_head_s_circle_is_wider_than_its_points_and_nobody_has_none():
    points = np.array([[[10.0, 20.0], [30.0, 20.0], [np.nan, np.nan]], np.full((3, 2), np.nan)])
    assert np.allclose(head_circles(points), [[20, 20, 22]])
    assert head_circles(np.full((2, 3, 2), np.nan)).shape == (0, 3)


def test_a_point_that_is_not_on_the_head_does_not_widen_the_circle():
    profile = np.array([[0.0, 0], [3, -4], [4, -4], [5, -4], [4, -3], [20, 2], [21, 2], [2, 6]])  # ears far away
    near, far = head_circles(profile[None])[0], head_circles(np.concatenate([profile, [[-170.0, 55.0]]])[None])[0]
    assert near[2] > 2 * np.linalg.norm(profile[5] - near[:2]) and np.allclose(far, near)


@pytest.fixture(scope="module")
def detector():
    pytest.importorskip("ai_edge_litert", reason="needs the extra detect")
    try:
        return FaceDetector(assets.detector_models())
    except AssetError as error:
        if "could not fetch" in str(error):
            pytest.skip(f"the package index cannot be reached: {error}")
        raise


@pytest.mark.network
@pytest.mark.parametrize(("video", "frame", "faces"), [
    ("mv4_upperbody_caliscope/port_1.mp4", 60, [(765, 185)]),
    ("video_balancing_4cam/videos/cam01.mp4", 30, [(80, 350), (690, 560)]),  # a bystander of 40 px, far away
    ("video_balancing_4cam/static_trial/videos/cam01.mp4", 2, [(333, 390)]),  # with a mask, half behind a skeleton
])  # fmt: skip
def test_faces_lie_within_circles(detector, data_dir, video, frame, faces):
    path = data_dir(video.split("/")[0]).joinpath(*video.split("/")[1:])
    with Video(path) as opened:
        found = detector(opened.read(frame), small=True)
    for face in faces:
        assert (np.linalg.norm(found[:, :2] - face, axis=1) < 0.7 * found[:, 2]).any(), found.round()
    assert found[:, 2].max() < 200
