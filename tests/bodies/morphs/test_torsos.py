"""A surface that blends to another by ω(t) while local morphs act on it (P1 3.2, 3.3 and 4)."""

import numpy as np
import pytest

from kinefit.bodies import BodyState, load_body
from kinefit.bodies.morphs.morphing import Morphing
from kinefit.bodies.morphs.operators import GlobalMorph, LocalMorph, Steering

BODY = load_body("humanoid_morphing")
REST = Morphing(BODY, operators=())
LOCAL = tuple(m for m in BODY.morphs if isinstance(m, LocalMorph))
OTHER = REST.skin.vertices * [1.1, 1.0, 0.9] + [0.0, 0.0, 0.01]  # a body of another build, node by node
OMEGA = {"sqrt": lambda t: 1.0 - np.sqrt(t), "linear": lambda t: 1.0 - t, "square": lambda t: 1.0 - t * t}


def state(t, raised):
    angles = BODY.default_state().angles.copy()
    angles[BODY.tree.coordinate("pro_sup_l")] = t
    angles[BODY.tree.coordinate("arm_add_r")] = -np.radians(raised)
    return BodyState(np.eye(4), angles)


@pytest.mark.parametrize("weight", OMEGA)
@pytest.mark.parametrize("t", [0.0, 0.3, 1.0])
def test_both_kinds_of_morphs_add_up(weight, t):
    blend = GlobalMorph(OTHER, Steering("pro_sup_l", 0.0, 1.0, weight=weight))
    both, local = (Morphing(BODY, operators=o).pose(state(t, 90.0)).vertices for o in ((blend, *LOCAL), LOCAL))
    x, w = REST.skin.vertices, OMEGA[weight](t)
    shape = Morphing(BODY, operators=(GlobalMorph(w * x + (1.0 - w) * OTHER, Steering("pro_sup_l", -2.0, -1.0)),))
    blended = shape.pose(state(t, 90.0)).vertices
    plain = REST.pose(state(t, 90.0)).vertices
    np.testing.assert_allclose(both - plain, (local - plain) + (blended - plain), atol=1e-12)
    assert np.abs(local - plain).max() > 0.02 and (t == 0.0) == (np.abs(blended - plain).max() < 1e-9)
