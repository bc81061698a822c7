"""Networks in whose world people are white discs, so that what is built around the networks can be tested exactly."""

import cv2
import numpy as np
import pytest

from kinefit.images.detectors.box_detector import DetectedPerson
from kinefit.images.detectors.layouts import BLAZEPOSE
from kinefit.images.detectors.roi import SIZE, PersonLandmarks


class DiscModels:
    """Finds discs: the middle of the hips is the disc's centre, the rim of the body 1.2 radii above it."""

    layout = BLAZEPOSE

    def __init__(self, *, only_one=True):
        self.only_one = only_one  # as the true detector, which overlooks those beside another
        self.looks = 0

    def find_people(self, image):
        self.looks += 1
        people = [DetectedPerson(np.array([c, c - (0, 1.2 * r)]), 0.9) for c, r in discs(image)]
        return people[:1] if self.only_one else people

    def search(self, image):
        return []

    def pose(self, crop, *, mask=True):
        near = sorted(discs(crop), key=lambda disc: np.linalg.norm(disc[0] - SIZE / 2))
        if not near or np.linalg.norm(near[0][0] - SIZE / 2) > SIZE / 4:
            nobody = np.zeros((33, 2)), np.zeros(33), np.zeros(33), *np.zeros((2, 2))
            return PersonLandmarks(*nobody, 0.0, np.zeros((SIZE, SIZE)) if mask else None, np.zeros((33, 3)))
        centre, radius = near[0]
        turn = np.linspace(0, 2 * np.pi, 33, endpoint=False)
        points = centre + radius * np.column_stack([np.cos(turn), np.sin(turn)])
        v, u = np.mgrid[:SIZE, :SIZE]
        inside = (np.hypot(u - centre[0], v - centre[1]) <= radius).astype(np.float32) if mask else None
        lifted = np.tile([0.1, 0.2, 0.3], (33, 1))
        return PersonLandmarks(
            points, np.full(33, 0.9), np.ones(33), centre, centre - (0, 1.2 * radius), 0.99, inside, lifted
        )


def discs(image):
    """(centre, radius) of every white patch, the largest first."""
    white = (image.min(axis=2) > 200).astype(np.uint8)
    count, _, stats, centres = cv2.connectedComponentsWithStats(white)
    found = [(centres[k], np.sqrt(stats[k, cv2.CC_STAT_AREA] / np.pi)) for k in range(1, count)]
    return sorted((disc for disc in found if disc[1] > 3), key=lambda disc: -disc[1])


@pytest.fixture
def draw():
    """Picture 320 px wide and 240 high with discs (u, v, radius)."""

    def picture(*there):
        image = np.zeros((240, 320, 3), np.uint8)
        for u, v, radius in there:
            cv2.circle(image, (round(u), round(v)), radius, (255, 255, 255), -1)
        return image

    return picture


@pytest.fixture
def models():
    return DiscModels()
