"""A tracker that starts, and starts again, from markers without names."""

from dataclasses import replace

import numpy as np
import pytest
from tests.fitting.tracking.movements import a_rig

from kinefit import Markers, Tracker, fit_marker_subject, learn_model
from kinefit.bodies.marker_sets import placement
from kinefit.errors import TrackingError
from kinefit.papers.unlabelled_markers import name_frame, start_from_markers
from kinefit.simulation import squat_and_wave


@pytest.fixture(scope="module")
def person():
    """A motion at 30 Hz, its labelled markers, the subject's body and the model of the markers."""
    motion = squat_and_wave(rate=30)
    points = placement(motion.body, "CMU_41").points
    labelled = Markers(tuple(f"Anna:{n}" for n in points.names), 30.0, motion.positions(points), up="z")
    return motion, labelled, fit_marker_subject(motion.body, labelled, frames=20), learn_model(labelled, name="Anna")


def shuffled(labelled, frame, seed=0):
    return np.random.default_rng(seed).permutation(labelled.positions[frame])


def off(motion, frame, state, body):
    joints = motion.body.landmarks
    return np.linalg.norm(body.positions(state, body.landmarks) - motion.positions(joints)[frame], axis=1)


def test_a_state_from_points_without_names(person):
    motion, labelled, subject, model = person
    for frame in (0, 25, 50):
        state = start_from_markers(subject, model, shuffled(labelled, frame))
        assert np.median(off(motion, frame, state, subject.body)) < 0.02


def test_the_tracker_starts_and_starts_again_far_away(person):
    motion, labelled, subject, model = person
    up = np.eye(3)["xyz".index(motion.up)]
    tracker = Tracker(subject.body, a_rig(), rate=30.0, sigma={"markers": 0.01}, up=up)
    for step, frame in enumerate((0, 1, 2)):
        found = tracker.update([name_frame(model, shuffled(labelled, frame), step / 30, marker_set=subject.marker_set)])
        assert found is not None
        assert np.median(off(motion, frame, found.state, subject.body)) < 0.02
    moved = replace(labelled, positions=labelled.positions @ np.diag([-1.0, -1.0, 1.0]) + (1.5, 0.4, 0.0))
    for step in range(3, 30):  # carried elsewhere, and turned round
        points = shuffled(moved, 40)
        found = tracker.update([name_frame(model, points, step / 30, marker_set=subject.marker_set)])
    seen = np.array([np.linalg.norm(points - x, axis=1).min() for x in
                     subject.body.positions(found.state, subject.points)])  # fmt: skip
    assert np.median(seen) < 0.02


def test_too_few_points_are_no_start(person):
    _, labelled, subject, model = person
    with pytest.raises(TrackingError, match="fewer than six"):
        start_from_markers(subject, model, shuffled(labelled, 0)[:4])
