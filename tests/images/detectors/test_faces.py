"""Face meshes: the regions they are looked for in, faces that are none, and a true image of a seated person."""

from dataclasses import replace

import numpy as np
import pytest

from kinefit.errors import AssetError
from kinefit.images.detectors.box_detector import Models
from kinefit.images.detectors.detection import detect_people
from kinefit.images.detectors.faces import FaceFinder, FaceLandmarks, FaceModels, around_face, around_head
from kinefit.images.detectors.following import PersonDetection
from kinefit.images.detectors.roi import Roi
from kinefit.readers import assets
from kinefit.readers.videos.video import Video

IMAGE = np.zeros((480, 640, 3), np.uint8)
MESH = np.random.default_rng(2).uniform(-0.5, 0.5, (478, 2)) * [0.8, 1.0]  # of a face 1 px high, upright
MESH[10], MESH[152] = (0, -0.5), (0, 0.5)


def turned(points, turn):
    c, s = np.cos(turn), np.sin(turn)
    return points @ np.array([[c, -s], [s, c]]).T


def person(middle=(300, 200), height=100.0, turn=0.0):
    """Somebody with the landmarks of a face of a height [px] about a place."""
    points = np.zeros((33, 2))
    ears, eyes, mouth = [[-0.4, 0], [0.4, 0]], [[-0.15, -0.05]] * 3 + [[0.15, -0.05]] * 3, [[-0.1, 0.25], [0.1, 0.25]]
    points[:11] = turned(height * np.array([[0, 0.05], *eyes, *ears, *mouth]), turn) + middle
    return PersonDetection(0, points, np.ones(33), np.zeros(0, np.uint32), np.zeros((33, 3)))


class SeesFace(FaceModels):
    """Networks in whose world one face hangs at a place."""

    def __init__(self, middle=(300, 200), height=100.0, presence=0.9):
        self.points, self.presence, self.regions = height * MESH + middle, presence, []

    def landmarks(self, image, roi):
        self.regions.append(roi)
        return FaceLandmarks(self.points, self.presence)


@pytest.mark.parametrize("turn", [0.0, 1.0, 2.5, -2.0])
def test_regions_turn_with_the_head_and_hold_all_of_the_face(turn):
    points = turned(100 * MESH, turn) + [300, 200]
    for roi in (around_face(points), around_head(person(turn=turn).points)):
        assert np.isclose(np.cos(roi.turn - turn), 1.0, atol=1e-6)
        assert np.abs(turned(points - roi.centre, -roi.turn)).max() < roi.side / 2
    assert np.isclose(around_face(points).side, 150, rtol=0.01)


def test_a_face_is_looked_at_again_in_its_own_region():
    models = SeesFace()
    (found,) = FaceFinder(models)(IMAGE, [person()])
    points, confidence = found.face
    assert np.allclose(points, models.points) and np.allclose(confidence, 0.9)
    assert len(models.regions) == 2 and np.isclose(models.regions[1].side, around_face(points).side)


@pytest.mark.parametrize(
    ("models", "who"),
    [
        (SeesFace(presence=0.4), person()), (SeesFace(height=35), person()), (SeesFace(), person(height=20)),
        (SeesFace(middle=(420, 200)), person()), (SeesFace(), replace(person(), points=np.full((33, 2), np.nan))),
    ],
    ids=["no face", "too small", "a small head", "elsewhere", "nobody"],
)  # fmt: skip
def test_what_is_no_face_or_too_small_gives_nothing(models, who):
    (found,) = FaceFinder(models)(IMAGE, [who])
    assert np.isnan(found.face[0]).all() and not found.face[1].any()


def test_points_outside_of_the_image_have_no_confidence():
    (found,) = FaceFinder(SeesFace(middle=(300, 20)))(IMAGE, [person(middle=(300, 20))])
    above = found.face[0][:, 1] < -0.5
    assert above.any() and not found.face[1][above].any() and np.allclose(found.face[1][~above], 0.9)


@pytest.fixture(scope="module")
def networks():
    pytest.importorskip("ai_edge_litert", reason="needs the extra detect")
    try:
        return assets.detector_models()
    except AssetError as error:
        if "could not fetch" in str(error):
            pytest.skip(f"the package index cannot be reached: {error}")
        raise


@pytest.fixture(scope="module")
def seated(data_dir):
    with Video(data_dir("mv4_upperbody_caliscope") / "port_2.mp4") as video:
        return list(video.frames(20, 24))


@pytest.mark.network
def test_the_mesh_of_a_seated_person_lies_on_the_pose_s_head(networks, seated):
    found = detect_people(
        seated, Models(networks), camera="c", rate=6.0, people=1, masks=False,
        adders={"face": FaceFinder(FaceModels(networks))},
    )  # fmt: skip
    keypoints = found.keypoints(face=True)
    assert keypoints.keypoint_set == "MEDIAPIPE_478" and (keypoints.confidence[:, 0] > 0.5).all()
    uv = {name: keypoints.points[:, 0, k] for k, name in enumerate(keypoints.names)}
    size = np.linalg.norm(uv["face_forehead_top"] - uv["face_chin"], axis=1)
    for pose, mesh in ((0, "face_nose_point"), (3, "left_face_eye_outer"), (6, "right_face_eye_outer")):
        assert np.all(np.linalg.norm(found.points[:, 0, pose] - uv[mesh], axis=1) < 0.15 * size)
    for side, toward in (("right", 1), ("left", -1)):  # of the image: the nose is to its right of the right eye
        outer, inner = uv[f"{side}_face_eye_outer"][:, 0], uv[f"{side}_face_eye_inner"][:, 0]
        assert np.all(toward * (uv[f"{side}_face_iris"][:, 0] - outer) > 0)
        assert np.all(toward * (inner - uv[f"{side}_face_iris"][:, 0]) > 0)
        assert np.all(toward * (uv[f"{side}_face_iris_inner"] - uv[f"{side}_face_iris_outer"])[:, 0] > 0)
        assert np.all((uv[f"{side}_face_iris_bottom"] - uv[f"{side}_face_iris_top"])[:, 1] > 0)


@pytest.mark.network
def test_a_mirrored_face_has_the_mirrored_irises(networks, seated):
    models, image = FaceModels(networks), seated[0]
    points = detect_people(
        seated, Models(networks), camera="c", rate=6.0, people=1, masks=False, adders={"face": FaceFinder(models)}
    ).face[0, 0]
    roi, width = around_face(points), image.shape[1]
    mirrored = Roi(np.array([width - 1 - roi.centre[0], roi.centre[1]]), roi.side, -roi.turn)
    here, there = models.landmarks(image, roi), models.landmarks(np.ascontiguousarray(image[:, ::-1]), mirrored)
    back = np.column_stack([width - 1 - there.points[:, 0], there.points[:, 1]])
    right, left = [468, 469, 470, 471, 472], [473, 476, 475, 474, 477]
    off = np.linalg.norm(back[left + right] - here.points[right + left], axis=1)
    assert off.max() < 0.02 * roi.side and there.presence > 0.5
