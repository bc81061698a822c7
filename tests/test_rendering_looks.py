"""The one look of a body: the pieces of its skin, and what is lost or uncertain."""

from dataclasses import replace

import numpy as np
import pytest

from kinefit.bodies import load_body
from kinefit.bodies.rendering import looks
from kinefit.bodies.rendering.looks import body_mesh


def volume(mesh):
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return float(np.sum(a * np.cross(b, c))) / 6


def test_the_pieces_of_a_skin_are_all_of_it():
    body = load_body("humanoid")
    skin = body_mesh(body)
    pieces = looks.skin_pieces(skin)
    assert [p.segment for p in pieces] == list(range(len(body.tree.segments)))
    assert sum(len(p.mesh.faces) for p in pieces) == len(skin.triangles)
    assert sum(volume(p.mesh) for p in pieces) == pytest.approx(volume(looks.Mesh(skin.vertices, skin.triangles)))
    for p in pieces:
        assert np.allclose(p.weights.sum(axis=1), 1.0) and p.segment in p.followed
        others = {int(body.tree.parents[p.segment]), p.segment, *np.flatnonzero(body.tree.parents == p.segment)}
        assert p.weights[:, [k for k, s in enumerate(p.followed) if s in others]].sum(axis=1).mean() > 0.95


def test_a_body_without_surfaces_has_no_skin():
    assert looks.skin_pieces(body_mesh(replace(load_body("humanoid"), surfaces=()))) == []


def test_segments_are_uncertain_where_a_joint_at_either_end_is():
    body = load_body("humanoid")
    std = np.full((len(body.tree.segments), 3), 0.05)
    std[body.tree.segment("hand_r")] = 0.07, 0.07, 0.07
    std[body.tree.segment("toes_l")] = np.nan
    found = np.flatnonzero(looks.uncertain_segments(body, std))
    assert {body.tree.segments[s] for s in found} == {"forearm_r", "hand_r", "foot_l", "toes_l"}
    usual = np.ones((2, 3), np.uint8)
    both = looks.uncertain_segments(body, np.stack([np.zeros_like(std), std]))
    assert both.sum(axis=1).tolist() == [0, 4]  # over frames, too
    _, opacities = looks.segment_looks(np.array([1.0, 0.0]), usual, by_quality=False, uncertain=np.array([True, True]))
    assert 0.0 < opacities[1] < opacities[0] < 1.0


def test_a_lost_segment_is_grey_whatever_the_colours_mean():
    usual = np.array([[1, 2, 3]] * 3, np.uint8)
    for by_quality in (False, True):
        shades, opacities = looks.segment_looks(np.array([1.0, 0.6, 0.4]), usual, by_quality=by_quality)
        assert tuple(shades[2]) == looks.LOST_COLOUR and opacities[2] < 0.5
        assert list(opacities[:2]) == [1, 1]
    assert tuple(looks.segment_looks(np.ones(3), usual, by_quality=False)[0][0]) == (1, 2, 3)
