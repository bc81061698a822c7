"""What of a hand is fingers."""

import numpy as np
import pytest

from kinefit.bodies import load_body
from kinefit.bodies.limbs import knuckles, of_fingers


def test_fingers_begin_at_the_knuckles_of_both_hands_and_nowhere_else():
    body = load_body("humanoid")
    points = body.landmarks
    x = body.points_rest(points)
    told = dict(zip(points.names, of_fingers(body, points.segments, x)))
    assert {body.tree.segments[s] for s in knuckles(body)} == {"hand_r", "hand_l"}
    beyond = {name for name, is_so in told.items() if is_so}
    assert {"r_dactylion", "l_dactylion"} <= beyond
    assert beyond <= {f"{s}_{n}" for s in "rl" for n in ("dactylion", "metacarpal_phalanx_3")}  # and their own edge


def test_they_go_with_the_hand_s_length():
    body = load_body("humanoid")
    larger = body.scaled(np.where(np.array(body.scale_groups) == "hand", 1.2, 1.0))
    for s, knuckle in knuckles(body).items():
        assert knuckles(larger)[s] == pytest.approx(1.2 * knuckle)


def test_a_body_without_hands_has_none():
    body = load_body("humanoid10")
    x = np.random.default_rng(0).normal(size=(len(body.tree.segments), 3))
    assert not knuckles(body) and not of_fingers(body, np.arange(len(x)), x).any()
