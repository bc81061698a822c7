"""Joints of which frames in a row know nothing."""

import numpy as np

from kinefit.bodies import load_body
from kinefit.fitting.frame.results import unknown_joints

TREE = load_body("humanoid").tree
HAND, FOREARM, UPPERARM = (TREE.segments.index(f"{n}_r") for n in ("hand", "forearm", "upperarm"))


def flags(**frames):
    """(9, S) bool of each kind, true where named: kind = {segment: frames}."""
    out = {}
    for kind in ("lost", "hidden"):
        out[kind] = np.zeros((9, len(TREE.segments)), bool)
        for segment, which in frames.get(kind, {}).items():
            out[kind][which, segment] = True
    return out["lost"], out["hidden"]


def test_between_two_segments_that_are_unknown_near_a_contradiction_a_joint_is_adrift():
    told = flags(lost={FOREARM: [4]}, hidden={HAND: slice(None), FOREARM: [2, 3, 5, 6, 7]})
    out = unknown_joints(TREE, *told, 2)
    assert np.flatnonzero(out[:, HAND]).tolist() == [2, 3, 4, 5, 6]
    assert not np.delete(out, HAND, axis=1).any()  # the upper arm is where it is thought to be


def test_what_is_hidden_or_contradicted_alone_is_not():
    hidden = {HAND: slice(None), FOREARM: slice(None), UPPERARM: slice(None)}
    assert not unknown_joints(TREE, *flags(hidden=hidden), 2).any()
    assert not unknown_joints(TREE, *flags(lost={FOREARM: slice(None)}), 2).any()


def test_a_root_has_no_joint_of_its_own_but_its_place():
    lost = np.zeros((3, len(TREE.segments)), bool)
    lost[1, 0] = True
    np.testing.assert_array_equal(unknown_joints(TREE, lost, np.zeros_like(lost), 1)[:, 0], [False, True, False])
