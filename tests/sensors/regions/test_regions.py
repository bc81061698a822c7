"""A body's contour by the colours about it: found, told when it is not, and its rows hold while the match does."""

from dataclasses import replace

import numpy as np
import pytest
from tests.oracle import central_differences, design
from tests.sensors.region_scenes import CAMERA, RIG, frame, image, off, state, thing

from kinefit.bodies import load_body
from kinefit.errors import ObservationError
from kinefit.fitting.tracking.tracker import Tracker
from kinefit.geometry.camera import Camera, Rig
from kinefit.images.regions import RegionSettings
from kinefit.observations import ColourFrame
from kinefit.sensors.evidence import Evidence
from kinefit.sensors.regions.region_parts import spread_anchors
from kinefit.sensors.regions.regions import RegionSensor
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings

BODY, TRUTH = thing(), state()
SCENE = Scene(BODY, TRUTH, RIG)
ASIDE = state((0.004, -0.003, 0.004), (0.04, -0.03, 0.03))


def measured(at=ASIDE, **regions):
    """A measurement of the truth by a sensor that knows its colours, with the body expected elsewhere."""
    sensor = RegionSensor(CAMERA, 0.5, TrackSettings(regions=RegionSettings(**regions)))
    first = sensor.prepare(frame(TRUTH, seed=1), SCENE)
    sensor.learn(first, SCENE, True)
    return sensor.prepare(frame(TRUTH, seed=2), SCENE.at(at))


def tracker(**settings):
    out = Tracker(BODY, RIG, rate=30.0, settings=TrackSettings(**settings), up="y")
    out.start_at(TRUTH)
    out.update([frame(TRUTH)])
    return out


@pytest.mark.parametrize("options", [{}, {"anchors": 0}, {"space": "rgb"}])
def test_a_body_that_moved_is_found(options):
    there = state((0.012, 0.006, 0.0), (0.05, 0.06, -0.05))
    t = tracker(regions=RegionSettings(**options))
    for k in (1, 2, 3):
        found = t.update([frame(there, k / 30, seed=k)])
    away = off(found.state, there)
    assert away[0] < 0.006 and away[1] < 1.5
    assert found.quality > 0.8 and np.isfinite(found.dof_std).all()


def test_a_body_that_leapt_is_sought_and_found():
    """By nearly its own length and thirty degrees, after two frames in which nothing is seen of it."""
    there, t = state((0.11, 0.03, 0.06), (0.2, 0.4, 0.3)), tracker()
    for k in (1, 2):
        blank = ColourFrame("cam", k / 30, np.full((200, 240, 3), (100, 115, 110), np.uint8))
        assert t.update([blank]).hidden[0]
    for k in (3, 4, 5):
        found = t.update([frame(there, k / 30, seed=k)])
    assert off(found.state, there) < (0.01, 3.0) and not found.lost[0]


def test_colours_are_not_learnt_where_the_body_is_not_seen():
    """After forty images of nothing but a wall the thing is found again, by the colours that it had."""
    t = tracker()
    wall = ((100, 115, 110), (101, 116, 111))
    before = t.sensors.of("region cam").colours
    for k in range(1, 41):
        assert not t.update([ColourFrame("cam", k / 30, image(state((5.0, 0, 0)), wall=wall, seed=k))]).quality > 0.5
    assert t.sensors.of("region cam").colours.images <= before.images + 1
    for k in range(41, 45):
        found = t.update([frame(TRUTH, k / 30, seed=k)])
    assert off(found.state, TRUTH) < (0.01, 3.0) and not found.lost[0]


def test_light_may_change():
    t = tracker()
    for k in range(1, 9):
        found = t.update([frame(TRUTH, k / 30, seed=k, light=1.0 - 0.04 * k)])
    assert off(found.state, TRUTH) < (0.006, 1.5) and found.quality > 0.8


def test_the_papers_rule_comes_to_the_same_place():
    settings = TrackSettings(regions=RegionSettings(rule="shift"), iterations=20)
    t = Tracker(BODY, RIG, rate=30.0, settings=settings, up="y")
    t.start_at(TRUTH)
    t.update([frame(TRUTH)])
    there = state((0.004, 0.003, 0.0), (0.02, 0.02, 0.0))
    for k in range(1, 6):
        found = t.update([frame(there, k / 30, seed=k)])
    assert off(found.state, there) < (0.012, 3.0)


def test_what_is_nowhere_near_is_said_to_be_lost():
    t = tracker(search=False)
    away = state((-0.09, 0.05, 0.0))
    found = t.update([frame(away, 1 / 30)])
    assert found.lost[0] or found.hidden[0]


def test_equal_colours_tell_nothing():
    wall = ((190, 60, 50),) * 2
    t = Tracker(BODY, RIG, rate=30.0, up="y")
    t.start_at(TRUTH)
    found = [t.update([frame(TRUTH, k / 30, wall=wall, seed=k)]) for k in range(3)][-1]
    assert found.hidden[0] and found.quality < 0.5


def test_out_of_view_it_is_hidden():
    t = Tracker(BODY, RIG, rate=30.0, up="y")
    t.start_at(state((2.0, 0.0, 0.0)))
    assert t.update([frame(TRUTH)]).hidden[0]


def test_rows_are_a_pure_function_whose_derivative_is_that_of_the_rows():
    match = measured().match(SCENE.at(ASIDE), 0.03)
    assert (match.weight > 0).sum() > 50

    def whitened(s):
        (rows,) = match.rows(SCENE.at(s))
        return np.sqrt(rows.weight) * rows.residual

    for at in (ASIDE, ASIDE.retract(0.01 * np.random.default_rng(1).normal(size=6))):
        (rows,) = match.rows(SCENE.at(at))
        J = -np.sqrt(rows.weight)[:, None] * design(rows, BODY, at)
        slope = central_differences(whitened, BODY, at, 1e-6)
        # weights go with the pixels a metre makes, which change with the depth: a term of the residual's size
        np.testing.assert_allclose(J, slope, atol=0.02 * np.abs(J).max())


def test_rows_draw_the_contour_to_where_it_is():
    m, here = measured(), SCENE.at(ASIDE)
    match = m.match(here, 0.03)
    before = np.abs(match.leftovers(here)[0].values[0, 0]), match.leftovers(here)[0].rms[0]
    there = SCENE.at(TRUTH)
    after = match.leftovers(there)[0].rms[0]
    assert before[1] > 1.0 and after < 0.5 * before[1]


def test_what_is_kept_matches_as_the_image_does():
    m, here = measured(TRUTH), SCENE.at(TRUTH)
    m.match(here, 0.03)
    small = m.compact()
    assert small.image is None and len(small.seen.packed) < 30_000
    beside = SCENE.at(state((0.001, 0.0, 0.0), (0.005, 0.0, 0.0)))
    a, b = m.match(beside, 0.03), small.match(beside, 0.03)
    clear = (a.weight > 0) & (b.weight > 0)
    assert clear.sum() > 0.9 * max((a.weight > 0).sum(), 100)
    away = np.abs(a.place[:2] - b.place[:2])[:, clear]
    assert np.median(away) < 0.05 and np.percentile(away, 90) < 0.5
    told, kept = m.evidence(beside), small.evidence(beside)
    np.testing.assert_allclose(kept.quality, told.quality, atol=0.1)
    assert not small.starts(beside, None, Evidence.none(1))


def test_a_body_that_is_where_it_was_expected_is_not_sought():
    m, sure = measured(TRUTH), np.diag([1e6] * 3 + [1e4] * 3)
    assert list(m.starts(SCENE, sure, Evidence(np.ones(1), np.zeros(1)))) == []
    assert len(m.starts(SCENE, sure, Evidence(np.zeros(1), np.ones(1)))) == 3
    assert len(m.starts(SCENE, np.diag([1.0] * 6), Evidence(np.ones(1), np.zeros(1)))) == 3


def test_of_a_skin_that_morphs_rows_are_those_of_all_degrees_of_freedom():
    body = load_body("humanoid_morphing")
    camera = Camera("cam", (320, 240), [[260.0, 0, 159.5], [0, 260.0, 119.5], [0, 0, 1]])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.diag([1.0, -1.0, -1.0]), (0.0, 0.0, 3.0)
    scene = Scene(body, body.default_state(T), Rig((camera,)))
    sensor = RegionSensor(camera, 3.0, TrackSettings())
    picture, finder = np.full((240, 320, 3), (60, 90, 140), np.uint8), scene.surface.rims(camera)
    finder.find(scene.pose.vertices, camera)
    picture[finder.face >= 0] = 200
    match = sensor.prepare(ColourFrame("cam", 0.0, picture), scene).match(scene, 0.03)
    (rows,) = match.rows(scene)
    assert rows.jacobian.shape[1] == body.tree.n_dofs and rows.weight.max() > 0
    twice = replace(match, weight=2.0 * match.weight).rows(scene)[0]
    np.testing.assert_allclose(twice.weight, 2.0 * rows.weight)


def test_an_image_of_another_size_is_refused():
    with pytest.raises(ObservationError, match="240, 200"):
        RegionSensor(CAMERA, 0.5, TrackSettings()).prepare(ColourFrame("cam", 0.0, image(TRUTH)[::2]), SCENE)
    with pytest.raises(ObservationError, match="RGB"):
        ColourFrame("cam", 0.0, np.zeros((20, 20), np.uint8))


def test_anchors_are_spread():
    """Along a line of points each anchor has its own stretch, none much longer than the others."""
    near = spread_anchors(np.linspace(0.0, 1.0, 401)[:, None] * np.array([[0.3, 0.2, 0.1]]), 9)
    count = np.bincount(near)
    assert len(count) == 9 and count.max() < 3 * count.min()
