"""Nets about limbs that follow each other: closed, square, where the fields end."""

import numpy as np
import pytest

from kinefit.bodies import load_body
from kinefit.bodies.surfaces import Metaballs
from kinefit.bodies.surfaces.skins.skin_tubes import PosedLimb, field, tube
from kinefit.bodies.surfaces.skins.skinning import check_closed
from kinefit.errors import BodyError
from kinefit.geometry import se3

BODY = load_body("arm_metaballs")
LIMBS = [PosedLimb(s, se3.transform(np.eye(3), BODY.tree.rest[s.segment])) for s in BODY.surfaces]


@pytest.mark.parametrize("around", [8, 16, 32])
def test_a_closed_tube_faces_outwards_with_its_corners_where_the_fields_end(around):
    net = tube(LIMBS, around, (True, True))
    faces = net.faces()
    check_closed(faces)
    n = around // 4
    assert len(faces) == (len(net.rings) - 1) * around + 2 * n * n
    assert len(net.vertices) == len(net.rings) * around + 2 * (n - 1) ** 2
    assert field(LIMBS, net.vertices) == pytest.approx(0.5, abs=1e-5)
    a, b, c, d = np.moveaxis(net.vertices[faces], 1, 0)
    volume = np.sum(a * np.cross(b, c) + a * np.cross(c, d)) / 6
    assert 0.002 < volume < 0.005  # [m³] an arm
    long = np.linalg.norm(np.diff(net.vertices[net.rings], axis=0), axis=2).mean()
    wide = np.linalg.norm(np.roll(net.vertices[net.rings], 1, axis=1) - net.vertices[net.rings], axis=2).mean()
    assert 0.7 < long / wide < 1.4


def test_an_open_end_has_no_cap():
    closed, opened = tube(LIMBS, 16, (True, True)), tube(LIMBS, 16, (False, True))
    assert opened.caps[0] is None and np.array_equal(opened.rings, closed.rings)
    assert len(opened.faces()) == len(closed.faces()) - 16
    with pytest.raises(BodyError, match="16 edges have no twin"):
        check_closed(opened.faces())


def test_vertices_belong_to_the_limb_they_lie_on():
    net = tube(LIMBS, 16, (True, True))
    y = net.vertices[:, 1]
    for name, low, high in (("upperarm_r", -0.22, 0.1), ("forearm_r", -0.49, -0.36), ("hand_r", -0.8, -0.6)):
        assert set(net.segment[(y > low) & (y < high)]) == {BODY.tree.segment(name)}


def test_limbs_that_do_not_meet_are_refused():
    thin = [PosedLimb(Metaballs.of(p.limb.segment, p.limb.centres[:1], p.limb.radii[:1]), p.T) for p in LIMBS]
    with pytest.raises(BodyError, match="limbs of metaballs do not meet near"):
        tube(thin, 16, (True, True))
