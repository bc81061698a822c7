"""What an uncertain shape does to a pose is what fitting the pose anew in other worlds shows."""

from dataclasses import replace

import numpy as np
import pytest
from tests.fitting.subject import measured
from tests.fitting.subject.measured import ARM, RIG

from kinefit.fitting.smoothing.border import ShapeErrors, shape_errors
from kinefit.fitting.subject.fit import Worlds, fit_subject
from kinefit.fitting.subject.parameters import PointOffsets, SegmentScales, World
from kinefit.geometry.camera import Rig
from kinefit.sensors.base import matched_by, rows_at
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.solving.equations import inverse, normal_equations
from kinefit.solving.least_squares import levenberg_marquardt
from kinefit.solving.rows import ParameterRows, weaker

PRIOR = 0.3  # [rad] of every angle


@pytest.fixture(scope="module")
def found():
    states = measured.arms(12, seed=3)
    steps = measured.markers(ARM, states, noise=0.003)
    parameters = [SegmentScales(ARM), PointOffsets(ARM, "worn", 0.01)]
    subject = fit_subject(ARM, RIG, steps, states, parameters, rounds=2)
    return subject, steps


def prior_rows(state):
    count = len(state.angles)
    return ParameterRows(6 + np.arange(count), -state.angles, np.full(count, PRIOR**-2))


def rows_of(scene, matched, scale):
    return [*(weaker(rows, scale) for rows in rows_at(matched, scene)), prior_rows(scene.state)]


def refitted(scene, matched, start, scale):
    """The pose that a world's rows give."""
    rows = lambda state: rows_of(scene.at(state), matched, scale)
    return levenberg_marquardt(scene.body, start, rows, max_iterations=50, tolerance=1e-12).state


def centres(body, state):
    return body.tree.segment_poses(state.T_world_root[None], state.angles[None])[0, :, :3, 3]


@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_answers_are_those_of_poses_fitted_anew(found, scale):
    subject, steps = found
    worlds = Worlds(subject.prior_world, subject.parameters)
    world = worlds.at(subject.mean)
    frame = 4
    scene = worlds.scene(world, subject.states[frame])
    matched = matched_by(steps[frame][0], scene, 0.05)
    state = refitted(scene, matched, subject.states[frame], scale)
    scene = scene.at(state)
    H = normal_equations(world.body, state, rows_of(scene, matched, scale)).matrix
    alone = np.zeros_like(H)
    alone[6:, 6:] = inverse(H[6:, 6:])  # the arm's root is fixed
    scales = {matched.sensor: scale}
    errors = shape_errors(subject, TrackSettings(), lambda f: (scene, [matched]), [frame], [alone], scales)
    roots = np.linalg.cholesky(subject.covariance)
    dofs, joints = np.zeros(len(H)), np.zeros((len(world.body.tree.segments), 3))
    for direction in roots.T:
        moved = []
        for sign in (-0.5, 0.5):
            other = worlds.at(subject.mean + sign * direction)
            moved.append((other.body, refitted(worlds.scene(other, state), matched, state, scale)))
        (a, before), (b, after) = moved
        dofs += np.square(before.difference(after))
        joints += np.square(centres(b, after) - centres(a, before))
    assert joints.max() > 0.001**2
    np.testing.assert_allclose(np.sqrt(errors.joints[0]), np.sqrt(joints), rtol=0.05, atol=1e-4)
    np.testing.assert_allclose(np.sqrt(errors.dofs[0]), np.sqrt(dofs), rtol=0.1, atol=1e-3)


def test_a_shape_found_without_cameras_answers_to_pixels_too(found):
    subject, _ = found
    world = Worlds(subject.prior_world, subject.parameters).at(subject.mean)
    state = subject.states[4]
    scene = Scene(world.body, state, RIG)
    points = world.body.keypoints("COCO_17")
    uv = RIG.cameras[1].project(scene.positions(points)) + 3.0
    matched = matched_by(measured.Seen(RIG.names[1], 0.0, "COCO_17", uv), scene, 0.05)
    alone = 1e-4 * np.eye(world.body.tree.n_dofs)

    def errors(one):
        return shape_errors(one, TrackSettings(), lambda f: (scene, [matched]), [4], [alone])

    blind = errors(replace(subject, prior_world=World(ARM, Rig(()))))
    np.testing.assert_array_equal(blind.dofs, errors(subject).dofs)
    assert blind.dofs.max() > 0.0


def test_between_frames_variances_are_interpolated():
    factors = np.array([[[0.0, 0.0]], [[1.0, 0.0]]])
    errors = ShapeErrors(np.array([0, 10]), np.zeros((2, 1, 3)), factors)
    np.testing.assert_allclose(errors.factor_at(5), [[0.5, 0.0]])
    assert errors.at(0)[0] == 0.0 and errors.at(10)[0] == 1.0 and errors.at(4)[0] == pytest.approx(0.4)
    assert ShapeErrors(np.array([3]), np.zeros((1, 1, 3)), factors[1:]).at(9)[0] == 1.0
