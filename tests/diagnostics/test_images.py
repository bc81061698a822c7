"""What the take says became of the calibration's image, against the black bars that a video has."""

import cv2
import numpy as np
import pytest

from kinefit.diagnostics.images import fit_image
from kinefit.readers.take.entries import CameraEntry


@pytest.fixture
def video(tmp_path):
    """A folder of images of 200 x 200 px with bars of so many px above and below."""

    def draw(bars):
        image = np.full((200, 200, 3), 180, np.uint8)
        image[:bars] = image[200 - bars :] = 0
        for k in range(3):
            cv2.imwrite(str(tmp_path / f"{k}.png"), image)
        return tmp_path

    return draw


@pytest.mark.parametrize(
    ("said", "bars", "found", "remedy"),
    [
        ("scaled", 20, ("fault", "letterboxed"), 'Write image = "letterboxed" into [[camera]] a.'),
        ("letterboxed", 0, ("fault", "picture"), 'Write image = "scaled" into [[camera]] a.'),
        ("letterboxed", 45, ("doubt", "picture"), 'Is it image = "scaled" in [[camera]] a?'),  # a dark scene
        ("letterboxed", 20, ("note", "letterboxed"), ""),
        ("scaled", 0, ("note", "picture"), ""),
        ("as calibrated", 20, ("fault", "letterboxed"), 'Write image = "letterboxed" into [[camera]] a.'),
    ],
)
def test_bars_contradict_what_the_take_says(video, said, bars, found, remedy):
    entry = CameraEntry(name="a", video=video(bars), image=said)
    fitting, findings = fit_image(entry, (400, 320), 30.0, frames=1)
    assert [(f.severity, f.kind) for f in findings] == [found]
    assert findings[0].cameras == ("a",) and findings[0].remedy == remedy
    assert fitting.image == ("letterboxed" if found == ("fault", "letterboxed") else said)
