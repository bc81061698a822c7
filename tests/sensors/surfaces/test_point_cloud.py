"""A scanner as a sensor of the tracker."""

from dataclasses import replace

import numpy as np
import pytest
from tests.fitting.tracking.movements import BODY, cloud_frame, turned
from tests.oracle import central_differences, design
from tests.sensors.scenes import at, ring
from tests.sensors.surfaces.test_depth_image import SETTINGS, TRUTH, apart, found, moving, scene

from kinefit.bodies import load_body
from kinefit.bodies.morphs.morphing import Morphing
from kinefit.bodies.parts import with_part
from kinefit.bodies.surfaces import MeshSurface
from kinefit.errors import BodyError
from kinefit.observations import PointCloud
from kinefit.sensors.scene import Scene
from kinefit.sensors.surfaces.point_cloud import PointCloudSensor
from kinefit.solving.correspondences import surface_rows
from kinefit.solving.rows import DofRows

WRONG = turned(TRUTH, arm_add_l=-12)


def measured(frame, state=TRUTH):
    return PointCloudSensor("scan", 0.01, SETTINGS).prepare(frame, scene().at(state))


@pytest.mark.parametrize("segment", [None, "forearm_l"])
@pytest.mark.parametrize("reach", [0.1, 0.03])
def test_at_the_match_the_rows_are_those_of_the_row_maker(segment, reach):
    frame = cloud_frame(0, segment)
    measurement, here = measured(frame, WRONG), scene().at(WRONG)
    (rows,) = measurement.match(here, reach).rows(here)
    expected = surface_rows(
        BODY, WRONG, measurement.points, max_distance=2.0 * reach, sigma=measurement._point_sigma,
        viewpoint=frame.viewpoint, segment=None if segment is None else BODY.tree.segment(segment),
    )  # fmt: skip
    assert len(rows) > 5
    np.testing.assert_allclose(rows.data[:7], expected.data[:7], atol=1e-9)
    np.testing.assert_allclose(rows.data[7], expected.data[7], rtol=1e-9)
    np.testing.assert_array_equal(rows.segment, expected.segment)
    factor, _ = rows.loss.of_rows(rows.data, rows.group)
    np.testing.assert_allclose(factor, (1.0 + (rows.residual / reach) ** 2) ** -2.0, rtol=1e-9)


def test_rows_are_a_pure_function_whose_derivative_is_that_of_the_rows():
    here = scene().at(WRONG)
    match = measured(cloud_frame(0), WRONG).match(here, 0.15)
    for state in (WRONG, WRONG.retract(0.02 * np.random.default_rng(1).normal(size=BODY.tree.n_dofs))):
        (rows,) = match.rows(scene().at(state))
        some = np.arange(0, len(rows), 9)
        slope = central_differences(lambda s, k=some: match.rows(scene().at(s))[0].residual[k], BODY, state, 1e-6)
        np.testing.assert_allclose(-design(rows, BODY, state)[some], slope, atol=1e-6)


def test_a_body_is_drawn_back():
    wrist = BODY.landmarks.names.index("l_wrist")
    end = found(measured(cloud_frame(0), WRONG), WRONG)
    assert apart(end, TRUTH)[wrist] < 0.01 < 0.05 < apart(WRONG, TRUTH)[wrist]


def test_evidence_and_residuals():
    arm, there = BODY.tree.segment("forearm_l"), scene()
    match = measured(cloud_frame(0, "forearm_l")).match(there, 0.1)
    assert np.flatnonzero(~match.evidence(there).hidden).tolist() == [arm]
    assert match.evidence(there.at(turned(TRUTH, arm_add_l=-60))).lost[arm]
    summary = match.leftovers(there)[0]
    assert np.flatnonzero(summary.count).tolist() == [arm] and summary.rms[arm] < 0.003
    assert abs(summary.values[:, 0][arm]) < 0.002 and np.isnan(summary.values[:, 0][0])
    whole = measured(cloud_frame(0))
    told = whole.match(there, 0.1).evidence(there)
    assert told.agreeing.max() <= 1.0 and (told.contrary == 0).all() and (~told.hidden).sum() > 5
    assert whole.hints(there).view is not None


def test_only_a_cloud_of_something_is_gated_and_an_empty_one_says_nothing():
    x = np.vstack([cloud_frame(0).points, np.tile([0.0, 1.0, 30.0], (50, 1))])
    some, body = (measured(PointCloud("scan", 0.0, x, on_body=known)) for known in (False, True))
    assert len(body.points) == len(some.points) + 50 == len(x)
    for frame in (PointCloud("scan", 0.0, np.zeros((0, 3))), PointCloud("scan", 0.0, np.zeros((0, 3)), segment="head")):
        measurement = measured(frame)
        match = measurement.match(scene(), 0.1)
        assert len(match.rows(scene())[0]) == 0 and measurement.hints(scene()).view is None
        assert match.evidence(scene()).hidden.all()
    with pytest.raises(BodyError, match="tail"):
        measured(PointCloud("scan", 0.0, x, segment="tail"))


def test_a_raised_arm_is_found_with_its_shoulder():
    body, rig = moving(), ring(1)
    truth, start = at(body, arm_flex_r=70, arm_add_r=-35), at(body, arm_flex_r=60, arm_add_r=-30)
    x = Morphing(body).pose(truth).vertices
    frame = PointCloud("scan", 0.0, x, on_body=True)
    here = Scene(body, start, rig)
    measurement = PointCloudSensor("scan", 0.005, SETTINGS).prepare(frame, here)
    end = found(measurement, start, body, at=here)
    arm = [body.tree.coordinate(n) for n in ("arm_flex_r", "arm_add_r")]
    assert np.degrees(np.abs(end.angles - truth.angles))[arm].max() < 2.0
    assert isinstance(measurement.match(here, 0.1).rows(here)[0], DofRows)


def test_points_on_a_mesh_stay_on_it_on_another_body():
    """A box held in the hand: on one twice as large, points stay on the same places of its faces."""
    v = 0.1 * (np.array([[k & 1, k >> 1 & 1, k >> 2 & 1] for k in range(8)]) - 0.5)
    sides = ((0, 4, 6, 2), (1, 3, 7, 5), (0, 1, 5, 4), (2, 6, 7, 3), (0, 2, 3, 1), (4, 5, 7, 6))
    faces = np.array([t for a, b, c, d in sides for t in ((a, b, c), (a, c, d))])
    box = MeshSurface(0, v + (0.0, -0.3, 0.0), faces)
    body = with_part(load_body("humanoid10"), "box", parent="forearm_l", surfaces=box)
    state, rig, random = at(body), ring(1), np.random.default_rng(0)
    here = Scene(body, state, rig)
    rest = box.vertices[faces][random.integers(0, 12, 60)]
    rest = np.einsum("nk,nki->ni", random.dirichlet(np.ones(3), 60), rest)
    f = here.frames[body.tree.segment("box")]
    x = (rest + body.tree.rest[body.tree.segment("box")]) @ f[:9].reshape(3, 3).T + f[9:]
    frame = PointCloud("scan", 0.0, x, segment="box")
    match = PointCloudSensor("scan", 0.01, SETTINGS).prepare(frame, here).match(here, 0.05)
    assert len(match.pairs.weight) == 60
    large = replace(body, surfaces=(*body.surfaces[:-1], body.surfaces[-1].scaled(2.0)))
    points, normals = match.pairs.anchors.on(large)
    at_rest = body.tree.rest[body.tree.segment("box")]
    np.testing.assert_allclose(points - at_rest, 2.0 * (match.pairs.anchors.points - at_rest), atol=1e-9)
    np.testing.assert_allclose(normals, match.pairs.anchors.normals, atol=1e-9)
