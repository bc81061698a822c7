"""The file of the built-in detector: written whole, read back, refused when damaged."""

from dataclasses import replace

import numpy as np
import pytest

from kinefit.errors import ExportError, FileError, ObservationError
from kinefit.exporters.motion_file import write_detections
from kinefit.observations import Detections
from kinefit.readers.landmarks.detections import detections_file, detections_key, read_detections


@pytest.fixture
def found():
    """Three frames of a picture 6 px wide and 4 high: person 1 always there, person 2 in the last frame."""
    rng = np.random.default_rng(0)
    points, confidence = rng.uniform(0, 4, (3, 2, 33, 2)), rng.uniform(size=(3, 2, 33))
    points[:2, 1], confidence[:2, 1] = np.nan, 0
    runs = [[5, 2, 17], [0, 24], [24], [23, 1]]  # of (0, 0), (1, 0), (2, 0), (2, 1)
    starts = np.cumsum([0, 3, 0, 2, 0, 1, 2])
    lifted = np.where(np.isfinite(points[..., :1]), rng.normal(size=(3, 2, 33, 3)), np.nan)
    return Detections("left", 50.0, (6, 4), points, confidence, np.concatenate(runs), starts, "left.mp4", lifted)


def test_what_is_written_is_read(found, tmp_path):
    path = tmp_path / "there" / "left.npz"
    write_detections(found, path, key="the key")
    read = read_detections(path)
    assert (read.camera, read.rate, read.size, read.source) == ("left", 50.0, (6, 4), str(path))
    assert np.allclose(read.points, found.points, equal_nan=True, atol=1e-5)
    assert np.allclose(read.confidence, found.confidence, atol=1e-6)
    assert np.allclose(read.lifted, found.lifted, equal_nan=True, atol=1e-6)
    assert read.times is None  # as in all files before there were times
    uneven = [0.0, 0.02, 0.06]
    write_detections(replace(found, times=uneven), path)
    assert read_detections(path).times.tolist() == uneven
    for wrong, problem in (([0.0, 0.1], "times of camera left"), ([0.0, 0.1, 0.1], "do not increase")):
        with pytest.raises(ObservationError, match=problem):
            replace(found, times=wrong)
    assert read.looked is None
    write_detections(replace(found, looked=[True, False, True]), path)
    assert read_detections(path).looked.tolist() == [True, False, True]
    assert read_detections(path).keypoints().looked.tolist() == [True, False, True]
    assert read_detections(path).within(1, 5).looked.tolist() == [True, True, False, True, True]
    with pytest.raises(ObservationError, match="looks of camera left"):
        replace(found, looked=[True])
    bare = replace(found, lifted=None)
    write_detections(bare, path, key="the key")
    assert read_detections(path).lifted is None
    assert read.seen.tolist() == [[True, False], [True, False], [True, True]]
    for f in range(3):
        for p in range(2):
            assert np.array_equal(read.mask(f, p), found.mask(f, p))
    assert detections_key(path) == "the key"
    assert list(path.parent.iterdir()) == [path]


def test_hands_are_written_and_read(found, tmp_path):
    rng = np.random.default_rng(1)
    hands, confidence = rng.uniform(0, 4, (3, 2, 2, 21, 2)), rng.uniform(size=(3, 2, 2, 21))
    hands[0, 0, 1], confidence[0, 0, 1] = np.nan, 0
    write_detections(replace(found, hands=hands, hand_confidence=confidence), tmp_path / "left.npz")
    read = read_detections(tmp_path / "left.npz")
    assert np.allclose(read.hands, hands, equal_nan=True, atol=1e-5)
    keypoints = read.keypoints()
    assert keypoints.points.shape == (3, 2, 75, 2) and keypoints.lifted.shape == (3, 2, 75, 3)
    at = keypoints.names.index("right_pinky_tip")
    assert at == 74 and np.allclose(keypoints.confidence[..., at], confidence[:, :, 1, 20], atol=1e-6)
    with pytest.raises(ObservationError, match="hands"):
        replace(found, hands=hands)


def test_faces_are_written_and_read(found, tmp_path):
    rng = np.random.default_rng(1)
    face, confidence = rng.uniform(0, 4, (3, 2, 478, 2)), rng.uniform(size=(3, 2, 478))
    face[:2, 1], confidence[:2, 1] = np.nan, 0
    write_detections(replace(found, face=face, face_confidence=confidence), tmp_path / "left.npz")
    read = read_detections(tmp_path / "left.npz")
    keypoints = read.keypoints(face=True)
    assert keypoints.keypoint_set == "MEDIAPIPE_478" and keypoints.names[468] == "right_face_iris"
    assert np.allclose(keypoints.points, face, equal_nan=True, atol=1e-5) and keypoints.lifted is None
    assert read.keypoints().keypoint_set == "MEDIAPIPE_33"
    longer = read.within(1, 6)
    assert np.allclose(longer.face[1:4], face, equal_nan=True, atol=1e-5)
    assert not longer.face_confidence[[0, 4, 5]].any()
    with pytest.raises(ObservationError, match="not detected"):
        found.keypoints(face=True)
    with pytest.raises(ObservationError, match="no face is found"):
        replace(read, face_confidence=np.zeros_like(confidence)).keypoints(face=True)
    with pytest.raises(ObservationError, match="face"):
        replace(found, face=face)


def test_masks_run_down_the_columns(found):
    mask = found.mask(0, 0)
    assert mask.shape == (4, 6) and np.argwhere(mask).tolist() == [[1, 1], [2, 1]]
    assert found.mask(1, 0).all() and not found.mask(2, 0).any()
    assert np.argwhere(found.mask(-1, 1)).tolist() == [[3, 5]]
    assert found.mask(0, 1) is None


def change(path, **arrays):
    with np.load(path) as archive:
        content = {key: archive[key] for key in archive.files}
    for key, value in arrays.items():
        content.pop(key, None)
        if value is not None:
            content[key] = np.asarray(value)
    np.savez(path, **content)


DAMAGE = {
    "cut": (lambda p: p.write_bytes(p.read_bytes()[:400]), "damaged"),
    "text": (lambda p: p.write_text("hello"), "not a file of the built-in detector"),
    "empty": (lambda p: p.write_bytes(b""), "damaged"),
    "other npz": (lambda p: np.savez(p, a=1), "not a file of the built-in detector"),
    "one array": (lambda p: p.write_bytes(b"\x93NUMPY\x01\x00v\x00" + b"{'descr': '<f8', 'fortran_order': False, "
                                           b"'shape': (1,), }".ljust(117) + b"\n" + bytes(8)), "built-in detector"),
    "version": (lambda p: change(p, version=2), "version 2; this kinefit reads version 1"),
    "no points": (lambda p: change(p, points=None), "do not fit.*points"),
    "points": (lambda p: change(p, points=np.zeros((3, 2, 32, 2))), "do not fit"),
    "starts": (lambda p: change(p, mask_starts=[0, 3, 2, 5, 5, 6, 8]), "do not fit"),
    "infinite": (lambda p: change(p, points=np.full((3, 2, 33, 2), np.inf)), "impossible"),
    "rate": (lambda p: change(p, rate=0.0), "impossible"),
    "folder": (lambda p: (p.unlink(), p.mkdir()), "no such file"),
}  # fmt: skip


@pytest.mark.parametrize("case", DAMAGE)
def test_a_damaged_file_is_told(case, found, tmp_path):
    damage, message = DAMAGE[case]
    path = tmp_path / "left.npz"
    write_detections(found, path, key="k")
    damage(path)
    with pytest.raises(FileError, match=message) as told:
        read_detections(path)
    assert str(path) in str(told.value) and told.value.remedy


def test_a_key_is_had_only_of_a_whole_file(found, tmp_path):
    path = tmp_path / "left.npz"
    assert detections_key(path) is None
    write_detections(found, path, key="k")
    path.write_bytes(path.read_bytes()[:-30])
    assert detections_key(path) is None


def test_only_npz_is_written(found, tmp_path):
    with pytest.raises(ExportError, match=r"left\.npz"):
        write_detections(found, tmp_path / "left.json")


def test_files_lie_beside_the_take(tmp_path):
    assert detections_file(tmp_path / "walk.toml", "cam 1") == tmp_path / "walk-detect" / "cam 1.npz"
    assert detections_file(tmp_path / "walk.toml", "a/../b").parent == tmp_path / "walk-detect"
