"""Feet that rest, leave and come back: contacts switch with hysteresis."""

import numpy as np
import pytest

from kinefit.bodies import load_body
from kinefit.fitting.smoothing.foot_contacts import find_contacts

RATE, BODY = 100.0, load_body("humanoid10")


def contacts(height, level):
    """(F,) bool: whether any point of the soles is held, of a stiff body that slides by `level` [m] and rises."""
    roots = np.tile(np.eye(4), (len(height), 1, 1))
    roots[:, 0, 3], roots[:, 1, 3] = level, height
    angles = np.zeros((len(height), len(BODY.tree.coordinates)))
    found = find_contacts(BODY, roots, angles, RATE, "y")
    assert len(found.points) and found.places.shape == (len(height), len(found.points), 3)
    return (found.weight > 0).any(axis=1)


def test_a_jump_lets_go_and_lands():
    t = np.arange(200) / RATE
    air = np.maximum(0.0, 0.5 * 9.81 * (t - 0.8) * (1.2 - t))
    held = contacts(air, np.zeros(200))
    assert held[:75].all() and held[130:].all() and not held[85:115].any()
    assert np.abs(np.diff(held.astype(int))).sum() == 2


@pytest.mark.parametrize(("speed", "held_on"), [(0.2, True), (0.4, False)])
def test_what_rests_is_held_until_it_is_twice_as_fast(speed, held_on):
    """A foot that stands, gives way for 50 ms, and stands: below 0.3 m/s it was never gone."""
    moved = np.cumsum(np.where((np.arange(160) >= 80) & (np.arange(160) < 85), speed, 0.0)) / RATE
    held = contacts(np.zeros(160), moved)
    assert held[:78].all() and held[88:].all() and held[80:84].all() == held_on


def test_what_is_only_nearly_slow_never_rests():
    assert not contacts(np.zeros(100), 0.2 * np.arange(100) / RATE).any()


def test_one_camera_alone_holds_what_hardly_moves_in_its_image():
    """Along the camera's ray a sole may seem to wander, at any height; across it moves as it does."""
    t = np.arange(100) / RATE
    angles = np.zeros((100, len(BODY.tree.coordinates)))
    for along, held in ((True, True), (False, False)):
        roots = np.tile(np.eye(4), (100, 1, 1))
        roots[:, 2 if along else 0, 3] = 0.5 * t  # half a metre a second
        found = find_contacts(BODY, roots, angles, RATE, "y", np.array([0.0, -0.9, -50.0]))
        assert (found.weight > 0).any(axis=1).all() == held
        assert (found.weight > 0).any() == held
        rests = found.places[found.weight[:, 0] > 0]
        assert np.array_equal(rests, np.broadcast_to(rests[:1], rests.shape))
