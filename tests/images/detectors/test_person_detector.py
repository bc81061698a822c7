"""The way back from a turned picture, and the parts that are searched."""

import numpy as np
import pytest

from kinefit.images.detectors.box_detector import DetectedPerson, squares


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_whoever_is_found_in_the_turned_picture_is_turned_back(quarters):
    image = np.zeros((30, 50))
    image[7, 11], image[20, 40] = 1, 2
    turned = np.rot90(image, quarters)
    points = np.array([np.argwhere(turned == value)[0][::-1] for value in (1, 2)], float)
    assert np.allclose(DetectedPerson(points, 1.0).turned_back(quarters, image.shape).points, [[11, 7], [40, 20]])


@pytest.mark.parametrize("size", [(1920, 1080), (1080, 1920), (640, 480), (500, 500)])
def test_squares_cover_the_picture_and_stay_in_it(size):
    covered = np.zeros(size[::-1], int)
    sides = set()
    for u, v, side in squares(*size):
        part = covered[v : v + side, u : u + side]
        assert part.shape == (side, side)
        part += 1
        sides.add(side)
    assert covered.min() >= 1 and min(sides) == min(size) // 2
