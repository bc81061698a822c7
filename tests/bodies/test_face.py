"""The humanoid with jaw and eyes."""

import numpy as np
import pytest

from kinefit.bodies import BodyState, load_body
from kinefit.bodies.limbs import FACE
from kinefit.bodies.toml.joint_names import FAMILIES, joint_map

BODY = load_body("humanoid_face")
TREE = BODY.tree


def place(name, **degrees):
    """[m] a landmark in the head's frame, at angles of the face."""
    angles = np.zeros(len(TREE.coordinates))
    for coordinate, value in degrees.items():
        angles[TREE.coordinate(coordinate)] = np.radians(value)
    at = TREE.segment_poses(np.eye(4)[None], angles[None])[0, TREE.segment("head")]
    x = BODY.positions(BodyState(np.eye(4), angles), BODY.landmarks.select((name,)))[0]
    return (x - at[:3, 3]) @ at[:3, :3]


def test_the_jaw_opens_down_and_back_and_not_up():
    moved = place("face_chin", jaw_opening=30) - place("face_chin")
    assert moved[1] < -0.02 and moved[0] < -0.04 and moved[2] == pytest.approx(0.0, abs=1e-12)
    d = TREE.coordinate("jaw_opening")
    assert TREE.lower[d] == 0.0 and np.degrees(TREE.upper[d]) == pytest.approx(35.0)
    assert np.allclose(place("face_nose_bridge", jaw_opening=30), place("face_nose_bridge"))


@pytest.mark.parametrize(("side", "out"), [("r", 1.0), ("l", -1.0)])
def test_eyes_turn_outwards_and_up(side, out):
    iris = f"{side}_face_iris"
    aside, up = (place(iris, **{f"eye_{kind}_{side}": 20}) - place(iris) for kind in ("abduction", "elevation"))
    assert (out * aside[2], up[1]) == pytest.approx((0.0105 * np.sin(np.radians(20)),) * 2)


@pytest.mark.parametrize(("kind", "sign", "std"), [("abduction", -1.0, 4.9), ("elevation", 1.0, 1.5)])
def test_eyes_look_the_same_way(kind, sign, std):
    """The prior mean of one eye follows the other: to the same side, and up together."""
    right, left = (TREE.coordinate(f"eye_{kind}_{side}") for side in "rl")
    precision = TREE.posture_precision
    assert 0.94 < -sign * precision[right, left] / precision[right, right] < 1.0
    assert np.degrees(precision[right, right] ** -0.5) == pytest.approx(std, abs=0.1)


def test_the_face_fits_the_head():
    """Places of the mesh lie near the humanoid's own landmarks, and are a mean adult's in size."""
    likes = {"face_nose_bridge": "sellion", "face_nose_point": "nose_tip", "face_chin_groove": "supramenton"}
    for point, own in likes.items():
        assert np.linalg.norm(place(point) - place(own)) < 0.03
    apart = np.linalg.norm(place("r_face_iris") - place("l_face_iris"))
    assert apart == pytest.approx(0.0634, abs=0.001)


@pytest.mark.parametrize("family", ["VRM, Unity", "iClone", "Rigify"])
def test_faces_of_characters_are_known(family):
    k = ("VRM, Unity", "Rigify", "iClone").index(family)
    joints = list(next(f for f in FAMILIES if f.name == family).joints.values())
    found = joint_map([*joints, *(names[min(k, len(names) - 1)] if segment != "jaw" else names[k == 2]
                                  for segment, names in FACE.items())])  # fmt: skip
    assert [found[segment] - len(joints) for segment in FACE] == [0, 1, 2]
    assert not set(FACE) & set(joint_map(joints))
