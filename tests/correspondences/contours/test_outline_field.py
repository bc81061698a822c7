"""The nearest outline by a look-up."""

import numpy as np
import pytest

from kinefit.correspondences.contours.outline_field import OutlineField
from kinefit.errors import ObservationError


def disc(centre=(60.0, 45.0), radius=20.0, size=(90, 120)):
    v, u = np.mgrid[: size[0], : size[1]]
    return 255 * ((u - centre[0]) ** 2 + (v - centre[1]) ** 2 < radius**2).astype(np.uint8)


def rim(radius, count=60):
    turn = 2 * np.pi * np.arange(count) / count
    n = np.stack([np.cos(turn), np.sin(turn)])
    return np.concatenate([np.array([[60.0], [45.0]]) + radius * n, n])


@pytest.mark.parametrize("radius", [15.0, 19.5, 28.0])
def test_points_beside_an_outline_get_its_tangent(radius):
    found, (i, k) = OutlineField.of(disc()).tangents(rim(radius))
    assert len(i) == 60 and list(k) == list(range(60))
    away = np.hypot(found[0] - 60, found[1] - 45)
    assert np.abs(away - 20).max() < 1.0
    np.testing.assert_allclose(np.hypot(found[2], found[3]), 1.0)
    assert (np.sum(found[2:] * rim(radius)[2:], axis=0) > 0.9).all()


def test_what_is_far_or_faces_another_way_gets_none():
    field = OutlineField.of(disc())
    assert len(field.tangents(rim(40.0), reach=10.0)[1][0]) == 0
    turned = rim(22.0)
    turned[2:] *= -1
    assert len(field.tangents(turned)[1][0]) == 0
    outside = rim(22.0)
    outside[0] += 500
    assert field.tangents(outside)[0].shape == (4, 0)


@pytest.mark.parametrize("mask", [np.zeros((9, 9), np.uint8), np.full((9, 9), 255, np.uint8), np.zeros((9, 9))])
def test_masks_without_an_outline_are_told(mask):
    with pytest.raises(ObservationError):
        OutlineField.of(mask)
