"""Information and lasting errors of other sensors are those of their definitions."""

from copy import copy
from dataclasses import replace

import numpy as np
import pytest

from kinefit import Recording
from kinefit.bodies.surfaces import segment_middles
from kinefit.bodies.surfaces.places import body_mesh
from kinefit.fitting.frame.fit import rows_of
from kinefit.fitting.frame.results import ROOT_PRIOR_STD
from kinefit.fitting.smoothing import sensor_noise
from kinefit.fitting.smoothing.packed import PackedMarkers
from kinefit.fitting.smoothing.smoother import as_tracked
from kinefit.fitting.smoothing.tracked_frames import squares_of
from kinefit.fitting.tracking.run import run
from kinefit.geometry.camera import Rig
from kinefit.observations import MarkerFrame
from kinefit.sensors.base import Matched, rows_at
from kinefit.sensors.settings import TrackSettings
from kinefit.simulation import squat_and_wave
from kinefit.solving.equations import block_diagonal, design, normal_equations
from kinefit.solving.rows import DofRows, PairRows, ParameterRows, Rows

HALF = 3


@pytest.fixture(scope="module")
def tracked():
    """24 frames of markers, a fifth of them unseen."""
    truth, rng = squat_and_wave(rate=20.0, duration=1.2), np.random.default_rng(0)
    points = truth.body.markers("HANIM_45")
    x = truth.positions(points) + rng.normal(0, 0.004, (len(truth), len(points), 3))
    x[rng.uniform(size=x.shape[:2]) < 0.2] = np.nan
    steps = [[MarkerFrame("mocap", i / 20.0, points.names, x[i], "HANIM_45")] for i in range(len(truth))]
    recording = Recording.of_frames(steps, Rig(()), rate=20.0)
    frames = run(replace(recording, start=(0, truth.state(0))), truth.body, TrackSettings())
    take = as_tracked(frames)
    assert take.others is None
    rows = replace(frames, scale={"mocap": 1.0}, points=np.zeros(len(truth)))
    nothing = PackedMarkers.of(truth.body, (), frames.times, take.markers.loss)
    by_rows = replace(take, markers=nothing, others=rows)
    matched = [rows.matched(rows.scene(f, take.roots, take.angles)) for f in range(len(truth))]
    return truth.body, take, by_rows, matched


@pytest.mark.parametrize("packed", [True, False])
def test_information_and_lasting_errors_are_sums_over_rows_and_frames(tracked, packed):
    body, block, take, matched = tracked
    n, T = body.tree.n_dofs, len(take.roots)
    found = sensor_noise.noise_of_sensors(block if packed else take, matched, half=HALF)
    pushes, stated, channels, followed = [], {}, {}, {}
    for f, several in enumerate(matched):
        scene, information = take.others.scene(f, take.roots, take.angles), np.zeros((n, n))
        pushes.append({})
        for m in several:
            (rows,) = rows_at(m, scene)
            J, w = design(body, scene.state, rows), rows.weight * squares_of(rows)[1]
            information += J.T @ (w[:, None] * J)
            posterior = np.linalg.inv(
                information + block_diagonal(np.eye(6) / ROOT_PRIOR_STD**2, body.tree.posture_precision)
            )
            left = 1.0 - np.sum((np.eye(len(J)) - J @ posterior @ (w[:, None] * J).T) ** 2, axis=1)
            for i, group in enumerate(rows.group):
                channel = channels.setdefault(m.channels[group], len(channels))
                pushes[-1][channel, i % 3] = w[i] * J[i]
                stated.setdefault((channel, i % 3), []).append(m.lasts / rows.weight[i])
                followed.setdefault(channel, []).append(left[i])
        of_frame = sensor_noise.square(found.information[f])
        assert np.allclose(of_frame, information, rtol=1e-9, atol=1e-9 * information.max())
    (components,) = found.components.values()
    unseen = 5.0 / (5.0 + 3.0 * sum(1.0 - np.mean(values) for values in followed.values()))  # of what is stated
    assert 0.03 < unseen < 0.3
    for f in range(T):
        near = pushes[max(f - HALF, 0) : f + HALF + 1]
        expected, shared = np.zeros((2, n, n)), np.zeros((3, n))
        for (channel, axis), values in stated.items():
            mean = sum((of.get((channel, axis), np.zeros(n)) for of in near), np.zeros(n)) / len(near)
            shared[axis] += components.shared[0][axis] * mean
            lasting = components.systematic[channel] ** 2
            drift = components.smoothed_drift[channel] ** 2 + unseen * max(np.mean(values) - lasting, 0.0)
            constant = components.bias[channel] ** 2 + components.bias_error[channel] ** 2
            expected += np.array([constant, drift])[:, None, None] * np.outer(mean, mean)
        expected[0] += shared.T @ shared
        of_frame = found.pushes(f)
        for push, known in zip((of_frame.constant, of_frame.drift), expected):
            assert np.allclose(push.T @ push, known, rtol=1e-4, atol=1e-5 * expected.max())
        posture = block_diagonal(np.zeros((6, 6)), body.tree.posture_precision)  # of a labelled take
        np.testing.assert_allclose(of_frame.rest, packed * posture)


class Surface(Matched):
    """Points of two segments' surfaces, each 5 mm off along its normal; the first of them as rows of a skin."""

    sensor, of_points, error = "surface", False, 0.0

    def __init__(self, body, state, seed, blended):
        random, self.blended = np.random.default_rng(seed), blended
        self.segment = np.repeat([body.tree.segment("thigh_r"), body.tree.segment("shank_r")], 40)
        centre = body.tree.segment_poses(state.T_world_root[None], state.angles[None])[0, self.segment, :3, 3]
        self.point = centre + random.normal(0.0, 0.1, (80, 3))
        normal = random.normal(size=(80, 3))
        self.normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)

    def rows(self, scene):
        error = np.broadcast_to(0.005 + self.error, 80)
        skin, plain = (
            Rows.of(self.segment[some], self.point[some], self.normal[some], error[some], 1.0 / 0.01**2)
            for some in (slice(self.blended), slice(self.blended, None))
        )
        J = design(scene.body, scene.state, skin)
        dense = DofRows(J, skin.residual, skin.weight, skin.group, segment=skin.segment)
        return [rows for rows in (dense, plain) if len(rows)]


@pytest.mark.parametrize("blended", [0, 30, 80])
@pytest.mark.parametrize("points", [0, 100])
def test_surfaces_move_the_pose_as_refitting_does(tracked, points, blended):
    body, _, take, _ = tracked
    T, n, settings = len(take.roots), body.tree.n_dofs, TrackSettings()
    others = replace(take.others, points=np.full(T, points), scale={})
    matched = [(Surface(body, others.scene(f, take.roots, take.angles).state, f, blended),) for f in range(T)]
    found = sensor_noise.noise_of_sensors(replace(take, others=others), matched, half=0)
    scene, (surface,) = others.scene(5, take.roots, take.angles), matched[5]
    information, lasting = found.pooled(5), found.pushes(5).rest
    alone = sensor_noise.covariance_alone(body, scene.state, information)

    def equations(error):
        """That a fit solves, with the surface elsewhere by an error [m] of each row."""
        moved = copy(surface)
        moved.error = error
        return normal_equations(body, scene.state, rows_of(scene, [moved], settings, points=points))

    as_it_is = equations(0.0)
    expected = np.zeros((n, n))
    for segment in np.unique(surface.segment):
        centre = middle_of(scene, body, segment)
        arm = np.cross(surface.point - centre, surface.normal)
        for lever, sigma in ((surface.normal, settings.skin_shift), (arm, settings.skin_turn)):
            for k in range(3):
                error = np.where(surface.segment == segment, sigma * lever[:, k], 0.0)
                answer = alone @ (equations(error).gradient - as_it_is.gradient)
                expected += np.outer(answer, answer)
    assert np.allclose(alone @ lasting @ alone, expected, rtol=1e-4, atol=1e-6 * expected.max())
    assert np.allclose(information, as_it_is.matrix, rtol=1e-6, atol=1e-6 * as_it_is.matrix.max())


def middle_of(scene, body, segment):
    """(3,) [m] middle of a segment's surface, in the world."""
    mesh = body_mesh(body)
    middle = segment_middles(mesh.vertices, mesh.segment, len(body.tree.segments))[segment]  # in the world at rest
    return scene.frames[segment, :9].reshape(3, 3) @ middle + scene.frames[segment, 9:]


class Bound(Matched):
    """Three rows between the hands, or on three angles, each off by its own constant error."""

    sensor, of_points, channels, lasts = "bound", True, ("a", "b", "c"), 0.0

    def __init__(self, pairs):
        self.pairs = pairs

    def rows(self, scene):
        errors, weight = np.array([0.01, -0.02, 0.03]), np.full(3, 1.0 / 0.02**2)
        if not self.pairs:
            return [ParameterRows(np.array([8, 11, 14]), errors, weight)]
        hands = [scene.body.tree.segment(name) for name in ("hand_r", "hand_l")]
        poses = scene.body.tree.segment_poses(scene.state.T_world_root[None], scene.state.angles[None])[0, hands, :3, 3]
        a, b = np.repeat(poses[:, None], 3, axis=1)
        return [PairRows(np.tile(hands, (3, 1)), a, b, np.eye(3), errors, weight)]


@pytest.mark.parametrize("pairs", [True, False])
def test_rows_between_segments_and_on_angles_have_errors_that_last(tracked, pairs):
    body, _, take, _ = tracked
    T = len(take.roots)
    others = replace(take.others, scale={})
    found = sensor_noise.noise_of_sensors(replace(take, others=others), [(Bound(pairs),)] * T, half=HALF)
    scene = others.scene(4, take.roots, take.angles)
    (rows,) = rows_at(Bound(pairs), scene)
    J = design(body, scene.state, rows)
    np.testing.assert_allclose(sensor_noise.square(found.information[4]), J.T @ J / 0.02**2, atol=1e-6)
    of = found.components["bound"]
    assert (of.bias > 0.0).all() and (of.jitter < 1e-9).all()
    assert np.linalg.norm(found.pushes(4).constant) > 0.0
