"""Information and lasting errors of other sensors are those of their definitions."""

import numpy as np
import pytest

from kinefit import MarkerFrame, Recording
from kinefit.geometry.camera import Rig
from kinefit.sensors.base import rows_at
from kinefit.sensors.settings import TrackSettings
from kinefit.simulation import squat_and_wave
from kinefit.smoothing import sensor_noise
from kinefit.smoothing.linearised import squares_of
from kinefit.smoothing.smoother import as_tracked
from kinefit.solvers.equations import design
from kinefit.tracking.run import run

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
    frames = run(recording, truth.body, TrackSettings(), start=(0, truth.state(0)))
    take = as_tracked(truth.body, frames, TrackSettings())
    matched = [take.others.matched(take.others.scene(f, take.roots, take.angles)) for f in range(len(truth))]
    return truth.body, take, matched


def test_information_and_lasting_errors_are_sums_over_rows_and_frames(tracked):
    body, take, matched = tracked
    n, T = body.tree.n_dofs, len(take.roots)
    none = np.zeros((n, n))
    found = sensor_noise.other_noise(
        body, take.others, matched, take.roots, take.angles, lambda f: none, half=HALF
    )  # fmt: skip
    pushes, stated, channels = [], {}, {}
    for f, several in enumerate(matched):
        scene, information = take.others.scene(f, take.roots, take.angles), np.zeros((n, n))
        pushes.append({})
        for m in several:
            (rows,) = rows_at(m, scene)
            J, w = design(body, scene.state, rows), rows.weight * squares_of(rows)[1]
            information += J.T @ (w[:, None] * J)
            for i, group in enumerate(rows.group):
                channel = channels.setdefault(m.channels[group], len(channels))
                pushes[-1][channel, i % 3] = w[i] * J[i]
                stated.setdefault((channel, i % 3), []).append(m.lasts / rows.weight[i])
        assert np.allclose(found.pooled(f, 0)[0], information, rtol=1e-9, atol=1e-9 * information.max())
    (components,) = found.components.values()
    for f in range(T):
        near = pushes[max(f - HALF, 0) : f + HALF + 1]
        expected, shared = np.zeros((n, n)), np.zeros((3, n))
        for (channel, axis), values in stated.items():
            mean = sum((of.get((channel, axis), np.zeros(n)) for of in near), np.zeros(n)) / len(near)
            shared[axis] += components.shared[0][axis] * mean
            expected += max(components.lasting[channel] ** 2, np.mean(values)) * np.outer(mean, mean)
        expected += shared.T @ shared
        assert np.allclose(found.pooled(f, 0)[1], expected, rtol=1e-8, atol=1e-9 * expected.max())
