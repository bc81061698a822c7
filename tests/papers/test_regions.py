"""The paper's region-based cycle, on rendered pictures; its densities against their definitions."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal
from tests.papers.test_silhouettes import pictures, rig, state
from tests.solving.test_closed import LEG

from kinefit.bodies import BodyState, load_body, parse_body
from kinefit.errors import BodyError, ObservationError
from kinefit.geometry.camera import Camera
from kinefit.papers import _colour_densities as densities
from kinefit.papers.regions import pose_from_regions, track_regions
from kinefit.solving.closed import onto
from kinefit.solving.correspondences.closures import closure_values, hard_equations

BODY, RIG = load_body("arm"), rig()


def off(found, truth):
    """[m] of the hand."""
    hand = [BODY.positions(s, BODY.landmarks.select(("r_wrist",)))[0] for s in (found.state, truth)]
    return float(np.linalg.norm(hand[0] - hand[1]))


def images(i, seed=0):
    """The red arm in the green room, with noise."""
    random = np.random.default_rng(seed)
    seen = pictures(BODY, state(BODY, i), RIG)
    return {n: np.clip(p + random.normal(0, 8, p.shape), 0, 255).astype(np.uint8) for n, p in seen.items()}


def cells_of(colours):
    """Cells of CIELab of colours (N, 3) uint8."""
    n = len(colours)
    camera = Camera("one", (n, 1), [[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1]])
    return densities.colour_cells(colours[None], camera)


@pytest.mark.parametrize("form, cycles", [("parzen", 20), ("mixture", 8)])
def test_an_arm_is_drawn_to_where_it_is_by_both_forms(form, cycles):
    """A pixel is a centimetre; the rule shifts by one."""
    begun, truth = state(BODY, 0), state(BODY, 2)
    fit, before = (
        pose_from_regions(BODY, begun, RIG, images(2), densities=form, cycles=count) for count in (cycles, 1)
    )
    assert fit.energy < before.energy and fit.cycles == cycles
    assert off(fit, truth) < 0.5 * off(before, truth)


def test_an_arm_is_followed():
    *_, last = track_regions(BODY, state(BODY, 0), RIG, (images(i, seed=i) for i in range(3)))
    assert off(last, state(BODY, 2)) < 0.012


def test_forces_cancel_and_the_rule_ends_the_cycles():
    fit = pose_from_regions(BODY, state(BODY, 0), RIG, images(0), epsilon=0.05)
    assert fit.converged and fit.cycles < 60
    assert not pose_from_regions(BODY, state(BODY, 0), RIG, images(1), epsilon=1e-12, cycles=5).converged


SURFACES = {
    'name = "hip", type = "revolute", axes = ["z"] }': "{ end = [0.0, 0.45, 0.0], radii = [0.07, 0.05] }",
    "range = [[-170, 0]] }": "{ end = [0.0, 0.3, 0.0], radii = [0.05, 0.035] }",
}


def pedal():
    """The pedal whose thigh and shank are seen and whose crank is not; closed poses a tenth of a turn apart."""
    text = LEG
    for joint, surface in SURFACES.items():
        text = text.replace(joint, f"{joint}\nsurface = {surface}")
    body = parse_body(text)
    T, equations, states = np.eye(4), hard_equations(body), []
    T[1, 3] = -0.3
    for crank in (0.85, 1.0):
        open_leg = BodyState(T, np.array([0.4, -0.9, crank]))
        states.append(onto(body, open_leg, equations, locked=np.arange(9) == 8)[0])
    return body, *states


def test_closures_hold_a_foot_on_its_pedal():
    """A shift of 1 px is 10 mm, a tenth of which the factor allows; the crank, which nobody sees, follows the foot."""
    body, begun, truth = pedal()
    seen = pictures(body, truth, RIG)
    gap, crank = {}, {}
    for name, one in {"closed": body, "open": replace(body, closures=())}.items():
        fit = pose_from_regions(one, begun, RIG, seen)
        gap[name] = float(np.linalg.norm(closure_values(body, fit.state)))
        crank[name] = np.degrees(abs(fit.state.angles[2] - truth.angles[2]))
    assert gap["closed"] < 0.001 and gap["open"] > 0.015
    assert crank["closed"] < 1.0 and crank["open"] > 8.0


def test_too_strong_a_factor_holds_the_body_in_place():
    body, begun, truth = pedal()
    fit = pose_from_regions(body, begun, RIG, pictures(body, truth, RIG), closure_factor=100.0)
    assert fit.state.angles[2] - begun.angles[2] < 0.1 * (truth.angles[2] - begun.angles[2])


def test_a_closure_that_the_paper_does_not_have_is_named():
    line = parse_body(LEG.replace('mode = "hard"', 'kind = "line"\naxis = "x"'))
    body = replace(pedal()[0], closures=line.closures)
    with pytest.raises(BodyError, match="closure 'foot' is a line"):
        pose_from_regions(body, pedal()[1], RIG, pictures(body, pedal()[1], RIG))


def test_the_energy_is_that_of_equation_8():
    """With one colour inside and another outside, and the body where it is, each pixel has the density of its own."""
    seen = pictures(BODY, state(BODY, 0), RIG)
    fit = pose_from_regions(BODY, state(BODY, 0), RIG, seen, cycles=1)
    flat = 0.0
    for image in seen.values():
        cell = cells_of(image.reshape(-1, 3))
        inside = (image == (200, 60, 50)).all(axis=2).ravel()
        counts = [np.bincount(cell[of], minlength=densities.COLOURS).astype(float) for of in (inside, ~inside)]
        p1, p2 = map(densities.parzen_density, counts)
        flat -= np.where(inside, p1[cell], p2[cell]).mean() / len(seen)
    assert fit.energy == pytest.approx(flat, abs=0.02)


def test_a_parzen_density_is_a_sum_of_windows_and_a_mixture_of_one_colour_a_gaussian():
    colours = np.tile(np.array([[180, 90, 60]], np.uint8), (50, 1))
    cell = cells_of(colours)
    count = np.bincount(cell, minlength=densities.COLOURS).astype(float)
    centres = (np.indices(densities._GRID_SHAPE).reshape(3, -1).T + 0.5) * densities._CELL_WIDTH
    away = centres - centres[cell[0]]
    near = np.linalg.norm(away, axis=1) < 9.0
    for form, variance in (("parzen", densities._PARZEN_SIGMA**2), ("mixture", densities._CELL_WIDTH**2 / 12)):
        told = np.exp(densities.DENSITIES[form](count))
        expected = multivariate_normal.pdf(away, cov=variance * np.eye(3)) + densities._MIN_DENSITY
        np.testing.assert_allclose(told[near], expected[near], rtol=0.15, atol=1e-7)


def test_what_cannot_be_is_refused():
    with pytest.raises(ObservationError, match="no part of the body"):
        T = np.eye(4)
        T[:3, 3] = 50.0
        pose_from_regions(BODY, BodyState(T, state(BODY, 0).angles), RIG, images(0))
    with pytest.raises(ObservationError, match="gauss"):
        pose_from_regions(BODY, state(BODY, 0), RIG, images(0), densities="gauss")
    with pytest.raises(ObservationError, match="uint8"):
        pose_from_regions(BODY, state(BODY, 0), RIG, {"front": images(0)["front"][::2]})


def test_a_parzen_density_is_a_gaussian_about_each_pixel_cut_at_the_edges():
    shape, width = densities._GRID_SHAPE, densities._CELL_WIDTH
    count = np.zeros(shape)
    count[1, 30, 40] = 5.0
    steps = np.arange(-4, 5) * width
    bell = np.exp(-0.5 * np.square(steps / densities._PARZEN_SIGMA))
    bell /= bell.sum()
    expected = np.zeros((shape[0] + 8, *shape[1:]))
    expected[1:10, 26:35, 36:45] = bell[:, None, None] * bell[:, None] * bell / width**3
    found = np.exp(densities.parzen_density(count.ravel())).reshape(shape)
    np.testing.assert_allclose(found, expected[4:-4] + densities._MIN_DENSITY, rtol=1e-9)
