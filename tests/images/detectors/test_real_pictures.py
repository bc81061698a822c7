"""The true networks on real pictures: against MediaPipe's own results, beside others, turned, in an empty room."""

import cv2
import numpy as np
import pytest

from kinefit.errors import AssetError
from kinefit.images.detectors.box_detector import Models
from kinefit.images.detectors.detection import detect_people
from kinefit.readers import assets
from kinefit.readers.videos.video import Video

pytestmark = pytest.mark.network


@pytest.fixture(scope="module")
def networks():
    pytest.importorskip("ai_edge_litert", reason="needs the extra detect")
    try:
        return Models(assets.detector_models())
    except AssetError as error:
        if "could not fetch" in str(error):
            pytest.skip(f"the package index cannot be reached: {error}")
        raise


@pytest.fixture(scope="module")
def trial(data_dir):
    return data_dir("video_balancing_4cam")


def pictures(trial, camera, frames):
    with Video(trial / "videos" / f"{camera}.mp4") as video:
        return [video.read(f) for f in frames]


def mask_on_file(trial, camera, frame):
    return cv2.imread(str(trial / "person_masks" / camera / f"{frame:03d}.png"), cv2.IMREAD_GRAYSCALE) > 127


def off(found, column, points):
    """(F,) median distance of a person's landmarks from given ones [px]."""
    return np.median(np.linalg.norm(found.points[:, column] - points, axis=-1), axis=1)


@pytest.mark.parametrize("camera", ["cam01", "cam03"])
def test_landmarks_and_masks_are_those_of_mediapipe(networks, trial, camera):
    """Whose landmarks are smoothed over time, ours are not; in the first picture they should be the same."""
    truth = np.load(trial / f"mediapipe_landmarks_{camera}.npy")[:6]
    found = detect_people(pictures(trial, camera, range(6)), networks, camera=camera, rate=60.0)
    assert found.points.shape[1] == 1 and found.seen.all()
    gaps = off(found, 0, truth[..., :2])
    assert gaps[0] < 4 and gaps.max() < 10
    assert np.abs(found.confidence[0, 0] - truth[0, :, 2]).mean() < 0.1
    for f in range(6):
        mine, theirs = found.mask(f, 0), mask_on_file(trial, camera, f)
        assert (mine & theirs).sum() / (mine | theirs).sum() > 0.95


def test_the_network_without_its_mask_says_the_same_of_all_else(networks, trial):
    crop = cv2.resize(pictures(trial, "cam01", [0])[0][400:1480], (256, 256))
    whole, part = networks.pose(crop), networks.pose(crop, mask=False)
    assert whole.mask is not None and part.mask is None
    for name in ("points", "visibility", "presence", "middle", "rim", "score", "lifted"):
        np.testing.assert_array_equal(getattr(part, name), getattr(whole, name))


def test_two_people_side_by_side_keep_their_columns(networks, trial):
    frames = range(0, 30, 3)
    images, others = pictures(trial, "cam02", frames), pictures(trial, "cam03", frames)
    A = np.array([[0.9, 0, 350], [0, 0.9, 150]])
    for f, image, other in zip(frames, images, others, strict=True):
        size = image.shape[1::-1]
        mask = cv2.warpAffine(mask_on_file(trial, "cam03", f).astype(np.uint8), A, size) > 0
        image[mask] = cv2.warpAffine(other, A, size)[mask]
    found = detect_people(images, networks, camera="cam02", rate=20.0, masks=False)
    truth = [np.load(trial / f"mediapipe_landmarks_{c}.npy")[::3][:10, :, :2] for c in ("cam02", "cam03")]
    truth[1] = truth[1] @ A[:, :2].T + A[:, 2]
    assert found.points.shape[1] == 2 and found.seen.all()
    first = int(off(found, 1, truth[0])[0] < off(found, 0, truth[0])[0])
    assert off(found, first, truth[0]).max() < 40 and off(found, 1 - first, truth[1]).max() < 40
    alone = detect_people(images[:3], networks, camera="cam02", rate=20.0, people=1, masks=False)
    assert alone.points.shape[1] == 1


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_people_in_a_turned_picture_are_found(networks, trial, quarters):
    (image,) = pictures(trial, "cam03", [0])
    truth = np.load(trial / "mediapipe_landmarks_cam03.npy")[0, :, :2]
    found = detect_people([np.ascontiguousarray(np.rot90(image, quarters))], networks, camera="c", rate=60.0)
    height, width = image.shape[:2]
    for _ in range(quarters):
        truth = np.column_stack([truth[:, 1], width - 1 - truth[:, 0]])
        height, width = width, height
    assert off(found, 0, truth)[0] < 12
    mask = np.rot90(mask_on_file(trial, "cam03", 0), quarters)
    assert (found.mask(0, 0) & mask).sum() / (found.mask(0, 0) | mask).sum() > 0.9


def test_a_small_person_is_found(networks, trial):
    """Tenth of the picture's height, of which the detector alone sees nothing."""
    (image,) = pictures(trial, "cam01", [0])
    truth = np.load(trial / "mediapipe_landmarks_cam01.npy")[0, :, :2]
    small = np.full_like(image, 90)
    A = np.array([[0.28, 0, 400], [0, 0.28, 700]])
    shrunk = cv2.resize(image, None, fx=0.28, fy=0.28, interpolation=cv2.INTER_AREA)
    small[700 : 700 + len(shrunk), 400 : 400 + shrunk.shape[1]] = shrunk
    found = detect_people([small], networks, camera="c", rate=60.0, masks=False)
    assert off(found, 0, truth @ A[:, :2].T + A[:, 2])[0] < 4


@pytest.mark.parametrize("camera", ["cam03", "cam04"])
def test_nobody_is_found_in_the_empty_room(networks, trial, camera):
    """With machines, boxes and a poster in it."""
    image = cv2.cvtColor(cv2.imread(str(trial / f"background_plate_{camera}.png")), cv2.COLOR_BGR2RGB)
    found = detect_people([image] * 3, networks, camera=camera, rate=4.0)
    assert found.points.shape[1] == 0
