"""Radii of metaballs from points: of one limb, and with poses, in turn and at once."""

import numpy as np
import pytest
from benchmarks.metaballs import arm, errors, joint

from kinefit.bodies import load_body
from kinefit.bodies.surfaces import Metaballs, nearest
from kinefit.errors import BodyError, ObservationError
from kinefit.recipes.metaball_bodies import metaball_bodies
from kinefit.subject.metaballs import MetaballShape, fit_balls, grown
from kinefit.subject.parameters import World
from kinefit.subject.surfaces import shape_of

BODY = load_body("arm_metaballs")
LIMB = BODY.surfaces[1]


def on(limb, count, rng):
    """Points exactly on a limb."""
    x = limb.vertices[rng.integers(0, len(limb.vertices), count)] * rng.uniform(0.99, 1.01, (count, 1))
    for _ in range(20):
        d = limb.derivatives(x)
        x = x + ((0.5 - d.value) / np.sum(d.by_point**2, axis=1))[:, None] * d.by_point
    return x


@pytest.mark.parametrize("weights", [False, True])
def test_radii_of_a_limb_are_found_as_well_as_stated(weights):
    z = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        values = 0.1 * rng.normal(size=9 + 3 * weights)
        true = grown(LIMB, values, weights=weights)
        x = on(true, 1500, rng) + 0.001 * rng.normal(size=(1500, 3))
        found = fit_balls(LIMB, x, 0.001, weights=weights)
        told = np.log(found.limb.radii / LIMB.radii).ravel()
        if weights:
            told = np.concatenate([told, np.log(found.limb.weights / LIMB.weights)])
        z.append((told - values) / found.std)
        assert found.rms == pytest.approx(0.001, rel=0.1)
        assert np.abs(np.ptp(found.limb.vertices, axis=0) / np.ptp(true.vertices, axis=0) - 1).max() < 0.05
    assert 0.6 < np.sqrt(np.mean(np.square(z))) < 1.5


def test_what_a_limb_cannot_be_fitted_to():
    rng = np.random.default_rng(0)
    with pytest.raises(ObservationError, match="5 points"):
        fit_balls(LIMB, rng.normal(size=(5, 3)), 0.001)
    with pytest.raises(BodyError, match="collapses|do not melt"):
        fit_balls(LIMB, 0.002 * rng.normal(size=(4000, 3)) + LIMB.centres[1], 1e-4)


def test_parameters_change_radii_and_nothing_else():
    shape = MetaballShape(BODY, weights=True)
    assert len(shape.names) == 36 and shape.names[0] == "upperarm_r ball 1 x" and len(shape.touches) == 36
    values = np.zeros(36)
    values[12 + 4] = 0.1
    there = shape.apply(World(BODY, None), values).body
    assert there.surfaces[1].radii[1, 1] == pytest.approx(np.exp(0.1) * LIMB.radii[1, 1])
    assert np.array_equal(there.surfaces[0].radii, BODY.surfaces[0].radii)
    assert [type(p) for p in shape_of(BODY)] == [MetaballShape]
    with pytest.raises(BodyError, match="no metaballs"):
        MetaballShape(load_body("arm"))


@pytest.fixture(scope="module")
def seen():
    return arm(5, 2, 400)


def test_radii_and_poses_in_turn(seen):
    body, points, truth, start = seen
    locked = np.arange(6 + len(body.tree.coordinates)) < 6
    found = metaball_bodies(BODY, points, start, sigma=0.001, locked=locked, iterations=4)
    radii, angles = errors(found.body, found.states, body, truth)
    assert found.rms < 0.0012 and angles.max() < 2.0 and np.sqrt(np.mean(radii**2)) < 0.12
    assert set(found.radii_std) == {"upperarm_r", "forearm_r", "hand_r"}
    with pytest.raises(ObservationError, match="no point lies near"):
        metaball_bodies(BODY, [x + 9.0 for x in points], start)
    with pytest.raises(ObservationError, match="1 poses"):
        metaball_bodies(BODY, points, start[:1])


def test_radii_and_poses_at_once(seen):
    body, points, truth, start = seen
    fitted, states = joint(BODY, [points[0]], start[:1])
    radii, angles = errors(fitted, states, body, truth[:1])
    assert angles.max() < 2.0 and np.sqrt(np.mean(radii**2)) < 0.05
    told = nearest(fitted, states[0], points[0], max_distance=0.05)
    assert np.sqrt(np.mean(told.distance[told.segment >= 0] ** 2)) < 0.0013
    assert all(isinstance(s, Metaballs) for s in fitted.surfaces)
