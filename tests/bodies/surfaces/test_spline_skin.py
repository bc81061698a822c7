"""The seamless skin over limbs of metaballs: closed, continuous, where the balls' fields end."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from kinefit.bodies import load_body
from kinefit.bodies.surfaces import Metaballs
from kinefit.bodies.surfaces.spline_skin import AROUND, chain_skin, chains
from kinefit.errors import BodyError

BODY = load_body("arm_metaballs")
LIMBS = chains(BODY)[0]
SKIN = chain_skin(BODY, LIMBS)
PATCH = SKIN.patch
LAST = len(PATCH.control) + 1.0


def test_limbs_that_follow_each_other_are_one_chain():
    assert [[BODY.tree.segments[limb.segment] for limb in chain] for chain in chains(BODY)] == [
        ["upperarm_r", "forearm_r", "hand_r"]
    ]
    alone = replace(BODY, surfaces=tuple(s for s in BODY.surfaces if BODY.tree.segments[s.segment] != "forearm_r"))
    assert [[limb.segment for limb in chain] for chain in chains(alone)] == [[1], [3]]


@pytest.mark.parametrize("order", [0, 1, 2])
def test_points_slopes_and_curvatures_are_continuous_over_all_borders(order):
    v = np.linspace(0, AROUND, 37)
    for du, dv in {(order, 0), (0, order)}:
        scale = np.abs(PATCH.at(np.linspace(1, LAST - 1, 50)[:, None], v, du=du, dv=dv)).max()
        for u in (1.0, 2.0, 17.0, 18.0, LAST - 1.0):
            left, right = PATCH.at(u - 1e-9, v, du=du, dv=dv), PATCH.at(u + 1e-9, v, du=du, dv=dv)
            assert np.abs(left - right).max() < 1e-6 * scale
        u = np.linspace(0.3, LAST - 0.3, 41)
        for border in (0.0, 5.0, float(AROUND - 1)):
            left, right = PATCH.at(u, border - 1e-9, du=du, dv=dv), PATCH.at(u, border + 1e-9, du=du, dv=dv)
            assert np.abs(left - right).max() < 1e-6 * scale
        np.testing.assert_allclose(PATCH.at(u, 0.25, dv=dv), PATCH.at(u, AROUND + 0.25, dv=dv), atol=1e-12)


def test_derivatives_are_those_of_differences():
    u, v, h = np.linspace(0.7, LAST - 0.7, 23), np.linspace(1.3, 30.1, 23), 1e-5
    for du, dv in ((1, 0), (0, 1)):
        slope = (PATCH.at(u + h * du, v + h * dv) - PATCH.at(u - h * du, v - h * dv)) / (2 * h)
        np.testing.assert_allclose(PATCH.at(u, v, du=du, dv=dv), slope, atol=1e-8)
        slopes = [PATCH.at(u + s * h * du, v + s * h * dv, du=du, dv=dv) for s in (1, -1)]
        bend = (slopes[0] - slopes[1]) / (2 * h)
        np.testing.assert_allclose(PATCH.at(u, v, du=2 * du, dv=2 * dv), bend, atol=1e-7)


@pytest.mark.parametrize("pole", [0, 1])
def test_the_patch_closes_in_a_point_with_one_tangent_plane(pole):
    v, u = np.arange(AROUND), (0.0, LAST)[pole]
    np.testing.assert_allclose(PATCH.at(u, v), np.tile(PATCH.ends[pole], (AROUND, 1)), atol=1e-12)
    slopes = PATCH.at(u, v, du=1)
    assert np.linalg.svd(slopes)[1][2] < 1e-6 * np.linalg.norm(slopes)
    np.testing.assert_allclose(slopes, -np.roll(slopes, AROUND // 2, axis=0), atol=1e-12)  # through it and on


def test_the_mesh_is_closed_faces_outwards_and_lies_where_the_fields_end():
    x, faces, _ = PATCH.mesh()
    edges = np.concatenate([faces[:, [i, (i + 1) % 3]] for i in range(3)])
    there, back = Counter(map(tuple, edges.tolist())), Counter(map(tuple, edges[:, ::-1].tolist()))
    assert there == back and set(there.values()) == {1}
    a, b, c = np.moveaxis(x[faces], 1, 0)
    assert 0.002 < np.sum(a * np.cross(b - a, c - a)) / 6 < 0.005  # [m³] an arm
    told = [limb.derivatives(x - BODY.tree.rest[limb.segment]) for limb in LIMBS]
    value = np.array([one.value for one in told])
    slope = np.array([one.by_point for one in told])[np.argmax(value, axis=0), np.arange(len(x))]
    off = (value.max(axis=0) - 0.5) / np.linalg.norm(slope, axis=1)  # [m]
    assert np.sqrt(np.mean(off**2)) < 0.001 and np.abs(off).max() < 0.003  # which at joints have an edge


def test_vertices_follow_their_limb_and_at_joints_both():
    x, _, u = PATCH.mesh()
    segments, weights = SKIN.weights(u)
    assert weights.sum(axis=1) == pytest.approx(1) and weights.min() >= 0 and weights[:, 0].min() >= 0.5 - 1e-9
    y = x[:, 1]
    for name, low, high in (("upperarm_r", -0.22, 0.1), ("forearm_r", -0.49, -0.36), ("hand_r", -0.8, -0.6)):
        inside = (y > low) & (y < high)
        assert inside.any() and set(segments[inside, 0]) == {BODY.tree.segment(name)} and weights[inside, 0].min() == 1
    at_elbow = np.abs(y + 0.29) < 0.004
    assert weights[at_elbow, 0].max() < 0.65
    assert {1, 2} == set(segments[at_elbow].ravel())


def test_limbs_that_do_not_meet_are_refused():
    thin = [Metaballs.of(limb.segment, limb.centres[:1], limb.radii[:1]) for limb in LIMBS]
    with pytest.raises(BodyError, match="limbs of metaballs do not meet near"):
        chain_skin(BODY, thin)
