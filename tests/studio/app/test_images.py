"""Images for the pages."""

import cv2
import numpy as np

from kinefit.exporters.report.page import scaled
from kinefit.studio.app.people import jpeg, unrecognisable


def test_the_longer_side_is_bounded_and_nothing_is_enlarged():
    image = np.zeros((400, 100, 3), np.uint8)
    assert scaled(image, 100).shape == (100, 25, 3) and scaled(image, 1000) is image


def test_a_jpeg_has_the_colours_of_the_image():
    image = np.zeros((60, 80, 3), np.uint8)
    image[..., 0] = 200  # red
    back = cv2.imdecode(np.frombuffer(jpeg(image, 40), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert back.shape == (30, 40, 3)
    np.testing.assert_allclose(back.reshape(-1, 3).mean(axis=0), (200, 0, 0), atol=4)


def test_an_unrecognisable_image_has_no_detail():
    noise = np.random.default_rng(0).integers(0, 255, (480, 640, 3)).astype(np.uint8)
    hidden = unrecognisable(noise)
    assert hidden.shape == noise.shape
    assert np.abs(np.diff(hidden.astype(int), axis=1)).mean() < 0.05 * np.abs(np.diff(noise.astype(int), axis=1)).mean()
