"""Radii of metaballs from points of one limb, by distances and by the field; parameters of a subject fit."""

import numpy as np
import pytest

from kinefit.bodies import load_body
from kinefit.errors import BodyError, ObservationError
from kinefit.fitting.subject.metaballs import (
    MetaballShape,
    _distances,
    _fields,
    fit_balls,
    fit_field,
    grown,
    refined,
    refined_body,
    unmeshed,
)
from kinefit.fitting.subject.parameters import World
from kinefit.fitting.subject.surfaces import shape_of

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
    with pytest.raises(ObservationError, match=r"shape \(5, 3\)"):
        fit_balls(LIMB, rng.normal(size=(5, 3)), 0.001)
    with pytest.raises(BodyError, match="collapses|do not join"):
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


@pytest.mark.parametrize("weights", [False, True])
def test_derivatives_of_the_field_agree_with_central_differences(weights):
    """P4, eqs. 14 and 15: ∂F/∂θ = −∂(1/2 − F)/∂θ."""
    rng = np.random.default_rng(1)
    values, x, h = 0.1 * rng.normal(size=9 + 3 * weights), on(LIMB, 200, rng) + 0.02 * rng.normal(size=(200, 3)), 1e-6
    J, _ = _fields(unmeshed(LIMB, values, weights), x, weights)
    for k, e in enumerate(h * np.eye(len(values))):
        above, below = (_fields(unmeshed(LIMB, values + s * e, weights), x, weights)[1] for s in (1, -1))
        np.testing.assert_allclose(-J[:, k], (above - below) / (2 * h), atol=1e-8)


@pytest.mark.parametrize("weights", [False, True])
def test_radii_are_found_by_the_field(weights):
    rng = np.random.default_rng(2)
    values = 0.1 * rng.normal(size=9 + 3 * weights)
    x = on(grown(LIMB, values, weights=weights), 1500, rng)
    found, std = fit_field(LIMB, x, 0.01, np.zeros(len(values)), weights=weights, iterations=200)
    np.testing.assert_allclose(found, values, atol=1e-5)
    assert (std > 0).all() and std.max() < 0.1


def test_a_prior_on_radii_is_a_help():
    x = LIMB.centres[1] + 0.01 * np.random.default_rng(0).normal(size=(400, 3))
    free, held = (fit_field(LIMB, x, 0.1, np.zeros(9), girth=g, iterations=60)[0] for g in (np.inf, 0.02))
    assert np.abs(free).max() > 5.0 and np.abs(held).max() < 0.5


@pytest.mark.parametrize("count", [6, 8, 12, 20])
def test_more_balls_make_the_same_surface(count):
    for limb in BODY.surfaces:
        fine = refined(limb, count)
        x = on(limb, 800, np.random.default_rng(0))
        assert len(fine.centres) == count
        assert np.abs(_distances(fine, x, False)[1]).max() < 0.001


def test_a_refined_limb_comes_nearer_to_a_shape_that_three_balls_do_not_have():
    """Eight balls with radii off by 15 %: 3,000 points with 1 mm of noise; the true surface is the judge."""
    coarse, fine = [], []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        true = grown(refined(LIMB, 8), 0.15 * rng.normal(size=24))
        x = on(true, 3000, rng) + 0.001 * rng.normal(size=(3000, 3))
        three = fit_balls(LIMB, x, 0.001).limb
        eight = fit_balls(refined(three, 8), x, 0.001).limb
        judge = on(true, 2000, np.random.default_rng(99))
        for rms, limb in ((coarse, three), (fine, eight)):
            rms.append(1e3 * np.sqrt(np.mean(_distances(limb, judge, False)[1] ** 2)))
    assert np.median(coarse) > 0.3
    assert max(fine) < 0.35 * min(np.median(coarse), 1.0)


def test_what_cannot_be_refined():
    for count in (2, 3):
        with pytest.raises(BodyError, match=f"{count} balls in place of 3"):
            refined(LIMB, count)
    with pytest.raises(BodyError, match="no limb of two or more"):
        refined_body(load_body("humanoid"), 8)
