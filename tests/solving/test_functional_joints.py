"""Centres and axes from movement alone, against ones that are known."""

import numpy as np
import pytest

from kinefit import Markers
from kinefit.errors import ObservationError
from kinefit.geometry.se3 import exp_so3
from kinefit.solving.functional_joints import functional_axis, functional_centre, sphere_centre

PELVIS, THIGH = ("A", "B", "C", "D"), ("E", "F", "G", "H")


def moving(turns, noise=0.0, seed=0, frames=200):
    """Two clusters of four that meet in a joint; its centre (F, 3) and the parent's rotations."""
    rng = np.random.default_rng(seed)
    parent, child = 0.15 * rng.standard_normal((2, 4, 3))
    child[:, 1] -= 0.25
    joint = np.array([0.05, -0.1, 0.08])
    s = np.linspace(0.0, 6.0, frames)
    Rp = np.stack([exp_so3(0.3 * np.array([np.sin(k), np.cos(1.3 * k), np.sin(0.7 * k)])) for k in s])
    tp = np.stack([s, 0.1 * np.sin(s), np.cos(s)], axis=1)
    R = np.stack([exp_so3(turns(k)) for k in s])
    centre = Rp @ joint + tp
    x = np.concatenate([
        np.einsum("fij,kj->fki", Rp, parent) + tp[:, None],
        np.einsum("fij,fjl,kl->fki", Rp, R, child) + centre[:, None],
    ], axis=1)  # fmt: skip
    return Markers(PELVIS + THIGH, 100.0, x + noise * rng.standard_normal(x.shape)), centre, Rp


def ball(k):
    return np.array([0.5 * np.sin(3 * k), 0.2 * np.sin(5 * k), 0.6 * np.cos(2 * k)])


def hinge(k):
    return np.array([0.0, 0.0, 0.6 * np.sin(2 * k)])


def test_a_ball_without_noise_is_found_exactly():
    markers, centre, _ = moving(ball)
    found = functional_centre(markers, PELVIS, THIGH)
    assert np.allclose(found.centre, centre, atol=1e-6)
    assert found.axis is None
    assert found.spread < 1e-6


@pytest.mark.parametrize("child", [("E",), ("E", "F"), THIGH])
def test_a_ball_with_noise_and_gaps(child):
    markers, centre, _ = moving(ball, noise=0.001)
    x = np.array(markers.positions)
    x[20:60, 1], x[90:100, 4], x[150:170] = np.nan, np.nan, np.nan
    x[30:35, 4] += 0.3  # mislabelled
    found = functional_centre(Markers(markers.names, 100.0, x), PELVIS, child)
    off = np.linalg.norm(found.centre - centre, axis=1)
    assert np.isnan(off[150:170]).all()
    assert np.nanmedian(off) < 0.004
    assert found.spread < 0.005


def test_a_hinge_and_its_axis():
    markers, centre, Rp = moving(hinge, noise=0.0005)
    found = functional_axis(markers, ["x:A", "B", "C", "D"][1:], THIGH)
    across = np.cross(found.axis, Rp[:, :, 2])
    assert np.abs(np.linalg.norm(across, axis=1)).max() < np.sin(np.deg2rad(2))
    off = found.centre - centre
    off -= np.einsum("fi,fi->f", off, Rp[:, :, 2])[:, None] * Rp[:, :, 2]
    assert np.linalg.norm(off, axis=1).mean() < 0.002
    assert found.turns[0] > 5 * found.turns[1]


def test_a_hinge_is_no_ball_and_a_held_joint_nothing():
    markers, _, _ = moving(hinge)
    with pytest.raises(ObservationError, match="about two axes"):
        functional_centre(markers, PELVIS, THIGH)
    with pytest.raises(ObservationError, match="about two axes"):
        functional_centre(markers, PELVIS, ["E"])
    still, _, _ = moving(lambda k: np.zeros(3))
    with pytest.raises(ObservationError, match="about its axis"):
        functional_axis(still, PELVIS, THIGH)


def test_turns_are_standard_deviations():
    markers, _, _ = moving(hinge, frames=2000)
    wanted = np.std(0.6 * np.sin(2 * np.linspace(0.0, 6.0, 2000)))
    assert functional_axis(markers, PELVIS, THIGH).turns[0] == pytest.approx(wanted, rel=0.05)


def test_bad_labels_and_too_little_seen_are_told():
    markers, _, _ = moving(ball)
    with pytest.raises(ObservationError, match="no marker 'Z'|'Z'"):
        functional_centre(markers, PELVIS, ["Z"])
    with pytest.raises(ObservationError, match="2 markers of a segment"):
        functional_centre(markers, PELVIS[:2], THIGH)
    x = np.array(markers.positions)
    x[5:, 2:4] = np.nan
    with pytest.raises(ObservationError, match="frames show enough"):
        functional_centre(Markers(markers.names, 100.0, x), PELVIS, THIGH)
    x[:, 2:4] = np.nan
    with pytest.raises(ObservationError, match="0 frames show enough"):
        functional_centre(Markers(markers.names, 100.0, x), PELVIS, THIGH)


@pytest.mark.parametrize("arc", [0.2, 0.6, 2.0])
def test_spheres_of_small_arcs_are_not_drawn_inwards(arc):
    rng = np.random.default_rng(1)
    centre, radii = np.array([1.0, -2.0, 0.5]), np.array([0.3, 0.45])
    n = arc * rng.uniform(-1, 1, (2000, 2, 3)) + np.array([0.0, -1.0, 0.0])
    n /= np.linalg.norm(n, axis=2, keepdims=True)
    x = centre + radii[:, None] * n + 0.001 * rng.standard_normal(n.shape)
    found, r, misfit = sphere_centre(x)
    assert np.linalg.norm(found - centre) < 0.004
    assert np.allclose(r, radii, atol=0.004)
    assert misfit == pytest.approx(0.001, rel=0.1)
