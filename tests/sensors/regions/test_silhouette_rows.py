"""A silhouette as a sensor of the tracker: prepared, matched, and rows that hold while the match does."""

from dataclasses import replace

import numpy as np
import pytest
from tests.oracle import central_differences, design
from tests.sensors.scenes import posture, ring
from tests.sensors.surfaces.test_depth_image import apart, softened

from kinefit.bodies import load_body
from kinefit.bodies.morphs.morphing import Morphing
from kinefit.bodies.rendering import Canvas, render_body
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Rig
from kinefit.observations import SilhouetteFrame
from kinefit.sensors.regions.silhouette import SilhouetteSensor
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.solving.correspondences.contours.outlines import outline_pairs, outline_rows
from kinefit.solving.least_squares import gauss_newton
from kinefit.solving.rows import DofRows

SETTINGS, RIG = TrackSettings(), ring()
BODY = load_body("humanoid")
TRUTH, ASIDE = posture(BODY, 3), posture(BODY, 1)
SCENE = Scene(BODY, TRUTH, RIG)


def measured(state=TRUTH, camera=RIG.cameras[0], scene=SCENE, truth=TRUTH):
    frame = SilhouetteFrame(camera.name, 0.0, render_body(scene.body, truth, camera).seen)
    return SilhouetteSensor(camera, 2.0, SETTINGS).prepare(frame, scene.at(state))


def whitened(match, scene):
    (rows,) = match.rows(scene)
    return np.sqrt(rows.weight) * rows.residual


@pytest.mark.parametrize("reach", [0.15, 0.03])
def test_at_the_match_the_rows_are_those_of_the_row_maker(reach):
    """And the loss softens at half the distance within which pairs are sought."""
    measurement, here = measured(ASIDE), SCENE.at(ASIDE)
    (rows,) = measurement.match(here, reach).rows(here)
    bound = max(reach * measurement.pixels_per_metre, 3.0 * measurement.sigma, 3.0)
    rim, image, sigma = measurement.rim(here), measurement.outline, measurement._row_sigma
    i, k = outline_pairs(rim.outline, image, reach=bound, angle=SETTINGS.angle)
    x = here.pose.vertices
    expected = outline_rows(BODY, ASIDE, rim.chosen(i), x, measurement.camera, image[:, k], sigma=sigma)
    assert len(rows) > 300
    np.testing.assert_allclose(rows.data[:7], expected.data[:7], atol=1e-9)
    np.testing.assert_allclose(rows.data[7], expected.data[7], rtol=1e-9)
    np.testing.assert_array_equal(rows.segment, expected.segment)
    pixels = rows.weight * rows.residual**2 * sigma**2
    factor, _ = rows.loss.of_rows(rows.data, rows.group)
    np.testing.assert_allclose(factor, (1.0 + pixels / (0.5 * bound) ** 2) ** -2.0, rtol=1e-9)


def test_rows_are_a_pure_function_whose_derivative_is_that_of_the_rows():
    match = measured(ASIDE).match(SCENE.at(ASIDE), 0.15)
    for state in (ASIDE, ASIDE.retract(0.02 * np.random.default_rng(1).normal(size=BODY.tree.n_dofs))):
        (rows,) = match.rows(SCENE.at(state))
        some = np.arange(0, len(rows), 11)
        slope = central_differences(lambda s, k=some: whitened(match, SCENE.at(s))[k], BODY, state, 1e-6)
        J = -np.sqrt(rows.weight)[some, None] * design(rows, BODY, state)[some]
        np.testing.assert_allclose(J, slope, atol=1e-5 * np.abs(J).max())


def test_on_a_wider_body_the_same_points_lie_further_out():
    """Where body and image agree, a body wider by 2 cm has its outline 2 cm beyond the image's: what a fit goes by."""
    measurement = measured()
    match = measurement.match(SCENE, 0.05)
    wide = replace(
        BODY, surfaces=tuple(replace(s, radii=tuple((a + 0.02, b + 0.02) for a, b in s.radii)) for s in BODY.surfaces)
    )
    told, same = match.leftovers(Scene(wide, TRUTH, RIG))[0], match.leftovers(SCENE)[0]
    many = same.count > 15
    shift = (told.values - same.values)[:, 0][many] / (measurement.pixels_per_metre / measurement.of.scale)
    assert many.sum() > 5 and np.median(shift) == pytest.approx(-0.02, abs=0.004)
    np.testing.assert_array_equal(told.count, same.count)
    assert len(match.rows(Scene(wide, TRUTH, RIG))[0]) == len(match.rows(SCENE)[0])


@pytest.mark.parametrize("compact", [False, True])
def test_a_posture_is_found(compact):
    state = ASIDE
    each = [measured(state, camera) for camera in RIG]
    each = [m.compact() for m in each] if compact else each
    for k in range(10):
        here = SCENE.at(state)
        rows = [r for m in each for r in m.match(here, 0.15 if k < 4 else 0.03).rows(here)]
        state = gauss_newton(BODY, state, softened(rows), damping=1e-2).state
    assert apart(state, TRUTH, BODY).mean() < 0.5 * apart(ASIDE, TRUTH, BODY).mean()
    assert apart(state, TRUTH, BODY).mean() < 0.01
    assert all(m.overlap(SCENE.at(state)) > 0.95 > m.overlap(SCENE.at(posture(BODY, 20))) for m in each)


def test_evidence_and_residuals_by_segments():
    measurement, gone = measured(), SCENE.at(posture(BODY, 40))
    match, arm = measurement.match(SCENE, 0.05), BODY.tree.segment("forearm_r")
    told = match.evidence(SCENE)
    assert told.agreeing.sum() > 20 * told.contrary.sum() and match.evidence(gone).contrary[arm] > told.contrary[arm]
    summary = match.leftovers(SCENE)[0]
    many = summary.count > 15
    assert summary.count.sum() == len(match.rim) and many.sum() > 5
    assert np.abs(summary.values[:, 0][many]).max() < 1.0 and summary.rms[many].max() < 2.0


def test_its_image_is_made_smaller_and_only_that_is_kept():
    camera = RIG.cameras[0].scaled((960, 720))
    kept = measured(camera=camera).compact()
    arrays = [v for v in vars(kept).values() if isinstance(v, np.ndarray)]
    assert kept.mask.shape == (240, 320) and kept.camera.size == (320, 240) and kept.sigma == pytest.approx(2.0 / 3)
    assert sum(a.nbytes for a in arrays) < 200_000
    away = np.r_[0.02, np.zeros(BODY.tree.n_dofs - 1)]
    for one, other in zip(*(m.match(SCENE, 0.05).rows(SCENE.at(TRUTH.retract(away))) for m in (kept, measured()))):
        assert len(one) == pytest.approx(len(other), rel=0.1)


def test_an_empty_mask_says_nothing_for_and_one_of_another_size_is_refused():
    of = SilhouetteSensor(RIG.cameras[0], 2.0, SETTINGS)
    assert of.name == "silhouette c0"
    empty = of.prepare(SilhouetteFrame("c0", 0.0, np.zeros((240, 320), np.uint8)), SCENE).match(SCENE, 0.1)
    assert len(empty.rows(SCENE)[0]) == 0 and empty.evidence(SCENE).agreeing.sum() == 0.0
    assert empty.evidence(SCENE).lost.sum() > 10 and (empty.leftovers(SCENE)[0].count == 0).all()
    with pytest.raises(ObservationError, match="masks of c0 have"):
        of.prepare(SilhouetteFrame("c0", 0.0, np.zeros((10, 10), np.uint8)), SCENE)


def test_a_body_that_morphs_makes_rows_of_all_its_angles():
    body = load_body("humanoid_morphing")
    truth, aside = posture(body, 6), posture(body, 4)
    model, camera, scene = Morphing(body), RIG.cameras[1], Scene(body, aside, Rig(RIG.cameras[:2]))
    seen = Canvas(camera.size).draw_for(camera, model.pose(truth).vertices, model.mesh.faces, cull=True).seen
    frame = SilhouetteFrame(camera.name, 0.0, seen.copy())
    match = SilhouetteSensor(camera, 2.0, SETTINGS).prepare(frame, scene).match(scene, 0.15)
    (rows,) = match.rows(scene)
    assert isinstance(rows, DofRows) and len(rows) > 200 and rows.loss is match.loss
    step, h = np.random.default_rng(0).normal(size=body.tree.n_dofs), 1e-6
    ends = [whitened(match, scene.at(aside.retract(s * h * step))) for s in (-1, 1)]
    slope, J = (ends[1] - ends[0]) / (2 * h), np.sqrt(rows.weight) * (rows.jacobian @ step)
    np.testing.assert_allclose(J, -slope, atol=1e-4 * np.abs(J).max())
