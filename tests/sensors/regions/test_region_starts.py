"""Seams between parts, limbs mirrored and limbs sought, on an arm of three coloured parts."""

import numpy as np
import pytest
from tests.oracle import central_differences
from tests.sensors.region_arm import CAMERA, RIG, arm, frame, state

from kinefit.bodies import PointSet
from kinefit.bodies.rendering import render_body
from kinefit.fitting.frame.results import angles_off_prediction
from kinefit.fitting.tracking.tracker import Tracker
from kinefit.observations import DepthFrame
from kinefit.sensors.evidence import Evidence
from kinefit.sensors.regions.region_parts import Limbs, Seams
from kinefit.sensors.regions.region_search import Flips
from kinefit.sensors.regions.regions import RegionSensor
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings

TRUTH = state(0.3, 0.4, -0.9)
SCENE = Scene(arm(), TRUTH, RIG)
ENDS = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.09, 0, 0]])


def measured():
    sensor = RegionSensor(CAMERA, 0.3, TrackSettings())
    sensor.learn(sensor.prepare(frame(TRUTH, seed=1), SCENE), SCENE, True)
    return sensor.prepare(frame(TRUTH, 1 / 30, seed=2), SCENE)


def seams(scene):
    m = measured()
    m.rim(scene)
    drawn, finder = m._drawn(scene), scene.surface.rims(CAMERA)
    finder.find(scene.pose.vertices, CAMERA, close=320)
    return Seams.found(scene, finder, CAMERA, m._drawn(scene), m.of.parts(scene).group), drawn


def test_rows_of_seams_have_their_derivative():
    match = measured().match(SCENE, 0.03)
    assert (match.sure > 0).sum() > 5
    at = TRUTH.retract(0.01 * np.random.default_rng(1).normal(size=arm().tree.n_dofs))
    rows = match.rows(SCENE.at(at))[1]
    slope = central_differences(lambda s: match.rows(SCENE.at(s))[1].residual, arm(), at, 1e-6)
    np.testing.assert_allclose(rows.jacobian, -slope, atol=1e-6)


@pytest.mark.parametrize("coordinate", [6, 7, 8])
def test_a_seam_moves_as_its_rows_say(coordinate):
    """Found anew after a joint has turned, the seam lies where its derivative moves it."""
    before, _ = seams(SCENE)
    delta = np.zeros(arm().tree.n_dofs)
    delta[coordinate] = 0.03
    there = SCENE.at(TRUTH.retract(delta))
    after, _ = seams(there)
    zero = np.zeros(len(before))
    rows = before.rows(SCENE, zero, zero + 1.0, None)
    moved = rows.jacobian @ delta * np.linalg.norm(before.pulls.sum(axis=0), axis=1)  # [px]
    old, new = before.lines.outline, after.lines.outline
    off = []
    for k in range(len(before)):
        predicted = old[:2, k] + moved[k] * old[2:, k]
        near = np.linalg.norm(new[:2] - predicted[:, None], axis=0)
        j = int(np.argmin(near))
        if (before.segments[k] == after.segments[j]).all() and near[j] < 4.0:
            off.append(abs(old[2:, k] @ (new[:2, j] - predicted)))
    assert len(off) > 8 and np.median(off) < 0.25


def test_what_is_kept_has_no_seams_and_says_so():
    m = measured()
    m.match(SCENE, 0.03)
    kept = m.compact().match(SCENE, 0.03)
    assert kept.seams is None and len(kept.rows(SCENE)) == 1


def test_a_mirrored_limb_has_the_same_place_in_the_image():
    flips, viewpoint = Flips(arm(), ENDS), CAMERA.centre_world
    found = list(flips.of(TRUTH, CAMERA))
    assert found
    joints, ends = arm().positions(TRUTH, flips._joints), arm().positions(TRUTH, flips._ends)
    for other in found:
        j, e = arm().positions(other, flips._joints), arm().positions(other, flips._ends)
        leans = [np.sum((b - a) * (a - viewpoint) / np.linalg.norm(a - viewpoint, axis=1)[:, None], axis=1)
                 for a, b in ((joints, ends), (j, e))]  # fmt: skip
        turned = np.abs(leans[0] + leans[1]) < 0.02
        assert turned[1:].any() and not np.allclose(leans[0], leans[1], atol=0.03)
        assert np.abs(CAMERA.project(e[1:2]) - CAMERA.project(ends[1:2])).max() < 16.0  # of 84: the rest is perspective


def test_only_flips_that_the_prediction_allows_are_looked_at():
    flips, n = Flips(arm(), ENDS), arm().tree.n_dofs
    assert flips.near(TRUTH, 1e6 * np.eye(n), TRUTH, CAMERA) == []
    assert len(flips.near(TRUTH, np.eye(n), TRUTH, CAMERA)) == len(list(flips.of(TRUTH, CAMERA)))


def test_a_limb_is_found_by_what_its_pixels_say():
    m = measured()
    limbs = Limbs(arm(), SCENE.surface.morphing.mesh, m.of.parts(SCENE).label)
    assert len(limbs.segments) == 1 and set(limbs.coordinates[0]) == {0, 1, 2}
    away = state(-0.4, -0.3, -0.1)
    found = away
    for _ in range(4):  # as it is done again and again
        found = limbs.sought(0, found, [], m.seen, CAMERA)
    points = PointSet(("elbow", "hand"), np.array([2, 2]), np.array([[0.0, 0, 0], [0.2, 0, 0]]))
    there, sought, before = (CAMERA.project(arm().positions(s, points)) for s in (TRUTH, found, away))
    assert np.abs(sought - there).max() < 20.0 < 60.0 < np.abs(before - there).max()  # px, of 84 a segment is long
    np.testing.assert_array_equal(found.T_world_root, away.T_world_root)


def test_of_two_states_the_one_that_the_pixels_show_is_better():
    m, away = measured(), SCENE.at(state(0.3, 0.4, -0.2))
    alone = SCENE.at(TRUTH, measurements=(m,)), away.at(away.state, measurements=(m,))
    assert m.better(*alone) is True and m.better(*alone[::-1]) is False
    assert m.better(SCENE, away) is None  # with other sensors, or none, it is not for colours alone to say


def test_limbs_are_sought_in_turn_and_not_too_often():
    m = measured()
    scene = SCENE.at(TRUTH, measurements=(m,))
    m.evidence(scene)
    sure, told = 1e4 * np.eye(arm().tree.n_dofs), Evidence(np.ones(3), np.zeros(3))
    assert len(m.starts(scene, sure, told)) <= 1  # it is where it is best already, or a trifle beside it
    assert list(m.starts(scene, sure, told)) == []


def test_what_leaps_is_not_held():
    n = arm().tree.n_dofs
    assert angles_off_prediction(TRUTH, 1e4 * np.eye(n), state(0.3, 0.4, -0.88)) is None
    free = angles_off_prediction(TRUTH, 1e4 * np.eye(n), state(0.3, 0.4, -0.5))
    np.testing.assert_array_equal(np.flatnonzero(free), [8])


def test_an_arm_that_waves_is_followed_and_a_wrong_start_is_found():
    def truth(k):
        return state(0.3 + 0.02 * k, 0.4 - 0.02 * k, -0.9 + 0.03 * k)

    tracker = Tracker(arm(), RIG, rate=30.0, sigma={"region cam": 0.3}, up="y")
    tracker.start_at(truth(0))
    for k in range(8):
        found = tracker.update([frame(truth(k), k / 30, seed=k)])
    assert np.abs(found.state.angles - truth(7).angles).max() < 0.12 and not found.lost.any()
    tracker.start_at(state(-0.5, -0.3, -0.1))
    for k in range(8, 20):
        found = tracker.update([frame(truth(8), k / 30, seed=k)])
    assert np.abs(found.state.angles - truth(8).angles).max() < 0.12 and not found.lost.any()


def test_beside_depth_colours_are_learnt_where_depth_found_the_body():
    """A start that is off by half a radian gives no part the wall's colours, as depth says where it is first."""
    drawn = render_body(arm(), TRUTH, CAMERA).depth.astype(np.float32)
    depth = np.where(np.isfinite(drawn), drawn, np.float32(2.0))
    tracker = Tracker(arm(), RIG, rate=30.0, sigma={"region cam": 0.3, "cam": 0.003}, up="y")
    tracker.start_at(state(-0.1, 0.1, -0.5))
    silent = tracker.update([DepthFrame("cam", 0.0, depth), frame(TRUTH)])
    assert not any((m.weight > 0).any() for m in silent.matched if m.sensor == "region cam")
    for k in range(1, 6):
        found = tracker.update([DepthFrame("cam", k / 30, depth), frame(TRUTH, k / 30, seed=k)])
    assert any((m.weight > 0).any() for m in found.matched if m.sensor == "region cam")
    assert np.abs(found.state.angles - TRUTH.angles).max() < 0.1 and not found.lost.any()
