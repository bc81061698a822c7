"""A depth camera as a sensor of the tracker: prepared, matched, and rows that hold while the match does."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from tests.fitting.tracking.movements import BODY, SENSOR, a_motion, a_rig, images, turned
from tests.oracle import central_differences, design
from tests.sensors.scenes import at, ring

from kinefit.bodies import load_body
from kinefit.bodies.morphs.morphing import Morphing
from kinefit.bodies.morphs.operators import JointMotion, Steering
from kinefit.bodies.rendering import Canvas, render_body
from kinefit.errors import BodyError, ObservationError
from kinefit.geometry.camera import Rig
from kinefit.observations import DepthFrame
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.sensors.surfaces.depth_image import DepthImageSensor
from kinefit.sensors.surfaces.depth_view import Background
from kinefit.solving.correspondences import depth_image_rows, free_space_rows, surface_rows
from kinefit.solving.correspondences.occupancy.free_space import FreeSpace
from kinefit.solving.equations import normal_equations
from kinefit.solving.least_squares import gauss_newton
from kinefit.solving.rows import DofRows

TRUTH, SETTINGS, WALL = a_motion().state(0), TrackSettings(), 4.0
WRONG = turned(TRUTH, arm_add_l=-12, hip_flexion_r=8).retract(np.array([0.03, 0.02, -0.03] + [0.0] * 22))


@cache
def scene():
    return Scene(BODY, TRUTH, a_rig())


@cache
def clean():
    """(H, W) [m] the body before a wall, without error."""
    depth = render_body(BODY, TRUTH, a_rig()["depth"]).depth
    return np.where(np.isfinite(depth), depth, WALL)


def sensor(sigma=0.01, settings=SETTINGS, background=None, camera=None):
    return DepthImageSensor("depth", camera or a_rig()["depth"], sigma, settings, background)


def measured(state=TRUTH, depth=None, of=None):
    frame = DepthFrame("depth", 0.0, clean() if depth is None else depth)
    return (of or sensor()).prepare(frame, scene().at(state))


def found(measurement, state, body=BODY, count=12, at=None):
    """A state after some rounds of match and solve, as the tracker makes them."""
    here = at or scene()
    for k in range(count):
        rows = measurement.match(here.at(state), 0.15 if k < count // 2 else 0.03).rows(here.at(state))
        state = gauss_newton(body, state, softened(rows), damping=1e-3).state
    return state


def softened(rows):
    """Rows with the factors of their own losses in their weights, never outliers."""
    out = []
    for r in rows:
        weight = r.weight * (1.0 if r.loss is None else r.loss.factor(r.weight * r.residual**2))
        group = np.full(len(r), -1)
        out.append(
            replace(r, weight=weight, group=group, loss=None) if isinstance(r, DofRows)
            else replace(r, data=np.vstack([r.data[:7], weight]), group=group, loss=None)
        )  # fmt: skip
    return out


def apart(a, b, body=BODY):
    return np.linalg.norm(body.positions(a, body.landmarks) - body.positions(b, body.landmarks), axis=1)


def by_hand(measurement, state, bound, sigma=0.01):
    """The rows of a match by the row makers, with the image drawn where the measurement was prepared."""
    camera, surface, depth = a_rig()["depth"], scene().surface, measurement.depth
    points = np.ascontiguousarray(measurement._points.T)
    shown, frames = measurement._shown, BODY.tree.forward(state.T_world_root, state.angles)[0]
    own = sigma / np.sqrt(measurement._share / 2.0)
    space = FreeSpace.of(depth, farthest=measurement._farthest, shown=shown, tolerance=3 * sigma + 0.03)
    return [
        surface_rows(BODY, state, points, max_distance=bound, sigma=own, viewpoint=camera.centre_world),
        depth_image_rows(
            frames, surface.samples, camera, depth, shown, reach=bound, sigma=measurement._sample_sigma
        ),
        free_space_rows(
            frames, surface.samples, space, camera, tolerance=3 * sigma + 0.03, sigma=SETTINGS.through * space.cell
        ),
    ]  # fmt: skip


@pytest.mark.parametrize("bound", [0.15, 0.05])
def test_at_the_match_the_rows_are_those_of_the_row_makers(bound):
    """Same points, normals, residuals and weights; the loss softens at half the bound."""
    measurement = measured(WRONG, images()[0])
    here = scene().at(WRONG)
    made, expected = measurement.match(here, bound).rows(here), by_hand(measurement, WRONG, bound)
    assert [len(r) > n for r, n in zip(made, (100, 50, 5))] == [True, True, True]
    for a, b in zip(made, expected, strict=True):
        np.testing.assert_allclose(a.data[:7], b.data[:7], atol=1e-9)
        np.testing.assert_allclose(a.data[7], b.data[7], rtol=1e-9)
        np.testing.assert_array_equal(a.segment, b.segment)
        assert len(np.unique(a.group)) == len(a) and a.group.min() >= 0
    for rows in made[:2]:
        factor, _ = rows.loss.of_rows(rows.data, rows.group)
        np.testing.assert_allclose(factor, (1.0 + (rows.residual / (bound / 2)) ** 2) ** -2.0, rtol=1e-9)
    factor, _ = made[2].loss.of_rows(made[2].data, made[2].group)
    assert (factor == 1.0).all()


def whitened(match, k, state):
    rows = match.rows(scene().at(state))[k]
    return np.sqrt(rows.weight) * rows.residual


def test_rows_are_a_pure_function_whose_derivative_is_that_of_the_rows():
    """∂(√w r)/∂δ = −√w (n, (x − c) × n) J, at the state of the match and beside it; asked twice they are the same."""
    here = scene().at(WRONG)
    match = measured(WRONG, images()[0]).match(here, 0.15)
    for state in (WRONG, WRONG.retract(0.02 * np.random.default_rng(1).normal(size=BODY.tree.n_dofs))):
        rows = match.rows(scene().at(state))
        for k, r in enumerate(rows):
            assert np.array_equal(r.data, match.rows(scene().at(state))[k].data)
            some = np.flatnonzero(r.weight > 0)[::7]
            slope = central_differences(lambda s, k=k, some=some: whitened(match, k, s)[some], BODY, state, 1e-6)
            J = -np.sqrt(r.weight)[some, None] * design(r, BODY, state)[some]
            np.testing.assert_allclose(J, slope, atol=2e-5 * np.abs(J).max())


def test_on_a_scaled_body_a_scaled_image_has_the_same_rows_scaled():
    """A body twice as large, twice as far off: every anchor moves as its surface does."""
    here = scene().at(WRONG)
    match = measured(WRONG, images()[0]).match(here, 0.1)
    double = BODY.scaled(np.full(len(BODY.scale_groups), 2.0))
    T = np.array(WRONG.T_world_root)
    T[:3, 3] *= 2.0
    large = Scene(double, replace(WRONG, T_world_root=T), a_rig())
    for pairs in (match.points, match.samples):
        rows = replace(pairs, x_world=2.0 * pairs.x_world).rows(large)
        same = pairs.rows(here)
        np.testing.assert_allclose(rows.residual, 2.0 * same.residual, atol=1e-9)
        np.testing.assert_allclose(rows.point, 2.0 * same.point, atol=1e-9)
        np.testing.assert_allclose(rows.direction, same.direction, atol=1e-9)
    with pytest.raises(BodyError, match="do not correspond"):
        match.rows(Scene(replace(BODY, surfaces=BODY.surfaces[1:]), WRONG, a_rig()))


def test_a_wider_body_makes_smaller_residuals():
    """Widening the body by 1 cm lowers the residuals of its sides by 1 cm: what a fit of its shape goes by."""
    match = measured(TRUTH).match(scene(), 0.05)
    wide = replace(
        BODY, surfaces=tuple(replace(s, radii=tuple((a + 0.01, b + 0.01) for a, b in s.radii)) for s in BODY.surfaces)
    )
    shift = match.points.rows(Scene(wide, TRUTH, a_rig())).residual - match.points.rows(scene()).residual
    assert np.median(shift) == pytest.approx(-0.01, abs=1e-4)


def test_a_body_is_drawn_back():
    measurement = measured(WRONG)
    assert apart(WRONG, TRUTH).mean() > 0.03 and apart(found(measurement, WRONG), TRUTH).mean() < 0.01


def told(measurement):
    """How much the rows towards the surface tell of the body, all together."""
    rows = measurement.match(scene(), 0.03).rows(scene())[:2]
    return sum(normal_equations(BODY, TRUTH, r).matrix.trace() for r in rows)


def test_as_many_patches_count_as_there_are_not_pixels():
    """Four times the pixels tell what the few told: their errors are alike within a patch."""
    camera = a_rig()["depth"]
    fine = replace(SENSOR, size=(320, 240), focal=288.0).camera(camera.T_camera_world, name="depth")
    depth = np.where(np.isfinite(d := render_body(BODY, TRUTH, fine).depth), d, WALL)
    assert told(measured(depth=depth, of=sensor(camera=fine))) == pytest.approx(told(measured()), rel=0.25)


def test_a_sensor_of_half_the_accuracy_counts_a_quarter():
    good, bad = (measured(of=sensor(sigma)).match(scene(), 0.1).rows(scene())[0] for sigma in (0.004, 0.008))
    much, little = (normal_equations(BODY, TRUTH, r).matrix.trace() for r in (good, bad))
    assert much == pytest.approx(4.0 * little, rel=0.05)


def test_evidence_and_residuals_by_segments():
    there = scene()
    gone = there.at(turned(TRUTH, arm_add_l=-70, elbow_flex_l=60))
    match, arm = measured().match(there, 0.05), BODY.tree.segment("forearm_l")
    seen, lost = match.evidence(there), match.evidence(gone)
    assert not seen.lost.any() and seen.quality[arm] > 0.9 and lost.lost[arm] and not lost.lost[0]
    aside = there.at(TRUTH.retract(np.r_[0.02 * a_rig()["depth"].T_camera_world[2, :3], np.zeros(22)]))
    for where, low, high in ((there, -0.004, 0.004), (aside, 0.008, 0.03)):
        summary = match.leftovers(where)[0]
        many = summary.count > 20
        assert many.sum() >= 5 and summary.count.sum() == len(match.points.weight) + len(match.samples.weight)
        assert ((summary.values[:, 0][many] > low) & (summary.values[:, 0][many] < high)).all()
        assert (summary.rms[many] >= np.abs(summary.values[:, 0][many]) / 2).all()
    empty = measured(depth=np.zeros((120, 160))).match(there, 0.05).leftovers(there)[0]
    assert (empty.count == 0).all() and np.isnan(empty.values).all() and np.isnan(empty.rms).all()


def test_its_own_hidden_parts_are_found_anew_after_some_matches():
    measurement = measured(WRONG, of=sensor(settings=replace(SETTINGS, render_every=2)))
    before = measurement._shown
    for _ in range(2):
        measurement.match(scene(), 0.1)
    assert measurement._shown is before
    measurement.match(scene(), 0.1)
    assert not np.array_equal(measurement._shown, before)


@pytest.mark.parametrize("scale", [1, 4])
def test_what_is_kept_is_small_and_still_matches(scale):
    fine = replace(SENSOR, size=(160 * scale, 120 * scale), focal=144.0 * scale)
    camera = fine.camera(a_rig()["depth"].T_camera_world, name="depth")
    depth = render_body(BODY, TRUTH, camera).depth
    whole = measured(WRONG, np.where(np.isfinite(depth), depth, WALL), sensor(camera=camera))
    small = whole.compact()
    arrays = [v for v in vars(small).values() if isinstance(v, np.ndarray)]
    assert sum(a.nbytes for a in arrays) < 200_000 and all(a.base is None for a in arrays)
    assert small.compact() is small and small.is_compact and not whole.is_compact
    a, b = (found(m, WRONG) for m in (whole, small))
    assert apart(a, TRUTH).mean() < 0.01 and apart(b, TRUTH).mean() < 0.01
    assert small.hints(scene()).view is not None
    there = scene().at(b)
    assert not small.match(there, 0.05).evidence(there).lost.any()
    if scale == 1:
        for one, other in zip(whole.match(scene(), 0.05).rows(scene()), small.match(scene(), 0.05).rows(scene())):
            assert abs(len(one) - len(other)) <= 0.05 * len(one) + 2


def test_a_coarse_camera_sees_the_kept_pixels():
    of = sensor()
    for step in (2, 3):
        x = of.camera.T_world_camera[:3, :3] @ (0.2, -0.1, 2.0) + of.camera.centre_world
        first = (step - 1) // 2
        np.testing.assert_allclose(step * of.coarse(step).project(x) + first, of.camera.project(x))
        assert of.coarse(step).size == np.zeros((120, 160))[first::step, first::step].shape[::-1]
        assert of.coarse(step) is of.coarse(step)


def test_a_background_is_learnt_and_left_out():
    table = clean().copy()
    table[60:80] = np.minimum(table[60:80], 2.6)
    background = Background(a_rig()["depth"], 0.01, 5)
    of = sensor(background=background)
    first = measured(depth=table, of=of)
    match = first.match(scene(), 0.05)
    match.evidence(scene())
    assert first._judged is not None
    of.learn(first, scene(), True)
    second = measured(depth=table, of=of)
    assert (second.depth < 0).mean() > 0.3 and second._points.shape[1] < first._points.shape[1]
    np.testing.assert_array_equal(np.abs(second.depth), np.abs(first.depth))
    seen = render_body(BODY, TRUTH, a_rig()["depth"]).depth
    assert (second.depth[np.isfinite(seen) & (seen < 2.5)] > 0).all() and second.hints(scene()).view is not None
    of.learn(second, scene().at(WRONG), True)  # which draws it
    of.learn(second.compact(), scene(), True)  # which has no image to be learnt from


@pytest.mark.parametrize("nothing", [0.0, np.nan])
def test_an_image_of_nothing_says_nothing(nothing):
    measurement = measured(depth=np.full((120, 160), nothing))
    match = measurement.match(scene(), 0.1)
    assert sum(float(r.weight @ r.residual**2) for r in match.rows(scene())) == 0.0
    assert measurement.hints(scene()).view is None and match.evidence(scene()).hidden.all()


def test_a_body_at_or_behind_the_camera_does_no_harm():
    camera = a_rig()["depth"]
    for behind in (0.0, 3.0):
        T = np.array(TRUTH.T_world_root)
        T[:3, 3] = camera.centre_world - behind * camera.T_camera_world[2, :3]
        state = replace(TRUTH, T_world_root=T)
        for measurement in (measured(state), measured(state).compact()):
            match = measurement.match(scene().at(state), 0.1)
            assert all(np.isfinite(r.data).all() for r in match.rows(scene().at(state)))
            assert np.isfinite(match.evidence(scene().at(state)).quality).all()


def test_what_cannot_be_is_told():
    with pytest.raises(ObservationError, match=r"\(80, 60\) px, its camera \(160, 120\)"):
        measured(depth=np.ones((60, 80)))
    with pytest.raises(BodyError, match="no surfaces"):
        sensor().prepare(DepthFrame("depth", 0.0, clean()), Scene(replace(BODY, surfaces=()), TRUTH, a_rig()))


# Bodies whose joints move with their angles


def moving(name="humanoid10"):
    """A body whose right shoulder moves up by 12 cm as its arm is raised."""
    body = load_body(name)
    lift = JointMotion("upperarm_r", np.array([0.0, 0.12, 0.0, 0.0, 0.0, 0.0]), Steering("arm_flex_r", 0.0, np.pi / 2))
    return replace(body, morphs=(lift,))


def test_arms_are_found_with_their_shoulders():
    body, rig = moving(), Rig(ring(3).cameras[:1])
    truth = at(body, arm_flex_r=70, arm_add_r=-35, elbow_flex_r=50)
    start = at(body, arm_flex_r=60, arm_add_r=-30, elbow_flex_r=42)
    model, camera = Morphing(body), rig.cameras[0]
    drawn = Canvas(camera.size).draw_for(camera, model.pose(truth).vertices, model.mesh.faces, cull=True).depth
    frame = DepthFrame("c0", 0.0, np.where(np.isfinite(drawn), drawn, 5.0))
    ends = {}
    for name, own in (("moving", body), ("stiff", replace(body, morphs=()))):
        here = Scene(own, start, rig)
        measurement = DepthImageSensor("c0", camera, 0.005, SETTINGS, None).prepare(frame, here)
        state = found(measurement, start, own, at=here)
        arm = [own.tree.coordinate(f"{n}_r") for n in ("arm_flex", "arm_add", "elbow_flex")]
        ends[name] = np.degrees(np.abs(state.angles - truth.angles))[arm].mean()
        rows = measurement.match(here.at(state), 0.05).rows(here.at(state))
        assert all(isinstance(r, DofRows) == (name == "moving") for r in rows)
    assert ends["moving"] < 1.5 and ends["stiff"] > 2 * ends["moving"]


def test_the_derivative_knows_of_moving_joints():
    body, rig = moving(), Rig(ring(3).cameras[:1])
    truth, camera = at(body, arm_flex_r=50, arm_add_r=-35), rig.cameras[0]
    model, here = Morphing(body), Scene(body, truth, rig)
    drawn = Canvas(camera.size).draw_for(camera, model.pose(truth).vertices, model.mesh.faces, cull=True).depth
    frame = DepthFrame("c0", 0.0, np.where(np.isfinite(drawn), drawn, 5.0))
    aside = truth.retract(0.03 * np.random.default_rng(2).normal(size=body.tree.n_dofs))
    match = DepthImageSensor("c0", camera, 0.01, SETTINGS, None).prepare(frame, here).match(here.at(aside), 0.1)
    step, h = np.random.default_rng(0).normal(size=body.tree.n_dofs), 1e-6
    for k, rows in enumerate(match.rows(here.at(aside))):
        ends = [match.rows(here.at(aside.retract(s * h * step)))[k] for s in (-1, 1)]
        slope = np.diff([np.sqrt(r.weight) * r.residual for r in ends], axis=0)[0] / (2 * h)
        J = np.sqrt(rows.weight) * (rows.jacobian @ step)
        assert len(rows) and rows.loss is not None
        np.testing.assert_allclose(J, -slope, atol=1e-4 * np.abs(J).max())
