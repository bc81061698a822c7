"""Records of whole takes: frames that do not count, and sides that are exchanged."""

import numpy as np
import pytest

from kinefit.errors import ObservationError
from kinefit.observations import KeypointFrame, Keypoints, Markers

NAMES = ("nose", "left_hip", "right_hip", "left_alone")


def two_people():
    """Five frames of two people, lifted."""
    x = np.arange(5 * 2 * 4 * 3, dtype=float).reshape(5, 2, 4, 3)
    return Keypoints("a", "", NAMES, 10.0, x[..., :2], x[..., 2] / 120, lifted=x)


def test_left_and_right_of_everybody_are_exchanged_and_known():
    seen, frames = two_people(), np.array([False, True, True, False, False])
    out = seen.exchanged(frames)
    for name in ("points", "confidence", "lifted"):
        old, new = getattr(seen, name), getattr(out, name)
        np.testing.assert_array_equal(new[~frames], old[~frames])
        np.testing.assert_array_equal(new[frames], old[frames][:, :, [0, 2, 1, 3]])
    assert [KeypointFrame.of_record(out, f, 0.0).sides_known for f in range(5)] == frames.tolist()
    assert out.rows(slice(2, 4), 0.0).sides_known.tolist() == [True, False]
    assert out.of_one(np.zeros(5, int)).sides_known.tolist() == frames.tolist()


def test_frames_without_detections_show_nobody():
    seen, frames = two_people(), np.array([True, False, False, False, True])
    out = seen.without(frames)
    assert np.isnan(out.points[frames]).all() and np.isnan(out.lifted[frames]).all()
    assert not out.confidence[frames].any()
    np.testing.assert_array_equal(out.points[~frames], seen.points[~frames])


def test_known_sides_are_of_every_frame():
    with pytest.raises(ObservationError, match="known sides"):
        Keypoints("a", "", ("nose",), 10.0, np.zeros((3, 1, 1, 2)), np.ones((3, 1, 1)), sides_known=np.ones(2, bool))


def test_empty_ends_of_markers_are_left_out_and_said():
    x = np.ones((10, 2, 3))
    x[:3], x[5], x[9] = np.nan, np.nan, np.nan
    whole = Markers(("A", "B"), 10.0, x, residual=np.zeros((10, 2)), first_frame=11)
    cut = whole.trimmed()
    assert whole.seen_frames == (3, 9) and len(cut) == len(cut.residual) == 6 and cut.first_frame == 14
    np.testing.assert_allclose(cut.times, whole.times[3:9])
    assert cut.notes == ("no markers in the first 3 and last 1 of 10 frames: left out",)
    assert cut.trimmed() is cut and np.isnan(cut.positions[2]).all()  # a gap between stays
    none = Markers(("A",), 10.0, np.full((4, 1, 3), np.nan))
    assert none.trimmed() is none
