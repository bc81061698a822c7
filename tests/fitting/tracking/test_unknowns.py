"""Which parameters a recording can tell: points first, then surfaces and what sensors do not know of themselves."""

from dataclasses import replace

import numpy as np
import pytest
from tests.fitting.subject import measured
from tests.fitting.subject.measured import ARM, Pulling, Rope
from tests.oracle import rig_around

from kinefit import Keypoints, Markers, load_body, track
from kinefit.fitting.subject.parameters import KnownLengths, PointOffsets, SegmentScales, World
from kinefit.fitting.subject.subject import CameraExtrinsics, Subject
from kinefit.fitting.subject.surfaces import CylinderShape
from kinefit.fitting.tracking.recording import Recording
from kinefit.fitting.tracking.unknowns import of_all, of_points
from kinefit.geometry.camera import Rig
from kinefit.observations import MarkerFrame, NamedMarkers
from kinefit.sensors.settings import CameraErrors
from kinefit.simulation import squat_and_wave

BODY = load_body("humanoid")
CALIBRATED = rig_around(4)
SET = next(iter(BODY.marker_sets))
SCALES = np.full(len(BODY.scale_groups), 1.04)
SIZED = Subject(BODY.scaled(SCALES), SCALES)


def a_recording(marker_set=SET, std=None):
    names = BODY.markers(SET).names
    markers = Markers(names, 10.0, np.zeros((4, len(names), 3)), up="z", unit="m")
    return Recording(0.1 * np.arange(4), 10.0, Rig(()), markers=(NamedMarkers("mocap", markers, marker_set, std=std),))


def test_cameras_are_sought_from_their_calibration_and_begin_where_they_were_found():
    prior = CameraExtrinsics(CALIBRATED, None, (0.003, 0.002))
    twist = np.linspace(-0.004, 0.004, 24)
    moved = prior.apply(World(BODY, CALIBRATED), twist).rig
    seen = tuple(
        Keypoints(name, "MEDIAPIPE_33", ("nose",), 10.0, np.zeros((4, 1, 1, 2)), np.ones((4, 1, 1)))
        for name in CALIBRATED.names[:3]
    )  # fmt: skip
    recording = replace(a_recording(), rig=moved, keypoints=seen)
    unknown = of_points(recording, BODY, SIZED, None, None, calibrated=CALIBRATED, cameras=CameraErrors(0.003, 0.002))
    assert kinds(unknown) == [SegmentScales, PointOffsets, CameraExtrinsics]
    assert unknown.world.rig is moved and unknown.parameters[2].free == CALIBRATED.names[:3]
    assert not unknown.start[-18:].any()
    np.testing.assert_allclose(unknown.parameters[2].mean, -twist[:18], atol=1e-9)
    assert kinds(of_points(recording, BODY, SIZED, None, None)) == [SegmentScales, PointOffsets]


def kinds(unknown):
    return [type(p) for p in unknown.parameters]


def test_markers_tell_lengths_and_their_own_places():
    unknown = of_points(a_recording(), BODY, SIZED, None, None)
    assert kinds(unknown) == [SegmentScales, PointOffsets]
    assert unknown.world.body.tree is BODY.tree
    lengths = unknown.start[: len(SCALES)]
    np.testing.assert_allclose(lengths, np.log(SCALES))
    np.testing.assert_allclose(unknown.start[len(SCALES) :], 0.0, atol=1e-12)
    assert unknown.start.shape == (sum(len(p.names) for p in unknown.parameters),)


def test_a_set_says_how_far_its_markers_may_sit_elsewhere():
    std = np.linspace(0.005, 0.03, len(BODY.markers(SET)))
    known = of_points(a_recording(std=std), BODY, SIZED, None, None).parameters[1]
    np.testing.assert_allclose(known.std, std)


def test_markers_that_are_not_worn_have_no_place():
    few = SIZED.body.markers(SET).select(SIZED.body.markers(SET).names[3:23])
    some = replace(SIZED, body=replace(SIZED.body, marker_sets={**SIZED.body.marker_sets, SET: few}))
    std = np.linspace(0.005, 0.03, len(BODY.markers(SET)))
    unknown = of_points(a_recording(std=std), BODY, some, None, None)
    assert len(unknown.parameters[1].names) == 3 * 20
    np.testing.assert_allclose(unknown.parameters[1].std, std[3:23])
    assert unknown.world.body.markers(SET).names == few.names


def test_a_height_holds_the_size():
    free, held = (of_points(a_recording(), BODY, SIZED, h, None).parameters[0] for h in (None, 1.9))
    assert held.mean[0] == pytest.approx(np.log(1.9 / BODY.stature)) and free.mean[0] == 0.0
    assert held.information.sum() > 10.0 * free.information.sum()


def test_another_trial_of_the_person_holds_lengths_as_sure_as_it_was():
    trial = Subject(SIZED.body, SCALES, covariance=np.diag(np.full(len(SCALES), 0.01**2)))
    lengths = of_points(a_recording(), BODY, SIZED, None, trial).parameters[0]
    assert isinstance(lengths, KnownLengths)
    np.testing.assert_allclose(lengths.mean, np.log(SCALES))
    np.testing.assert_allclose(np.diag(lengths.information) ** -0.5, 0.01)  # of logarithms, as the fit has it


def test_landmarks_as_markers_have_no_places_to_find():
    recording = a_recording(marker_set="")
    assert of_points(recording, BODY, SIZED, None, None) is None
    assert kinds(of_all(recording, SIZED.body, size=True, lengths=True, surfaces=False)) == [SegmentScales]


@pytest.mark.parametrize(("lengths", "expected"), [(True, [SegmentScales, CylinderShape]), (False, [CylinderShape])])
def test_surfaces_tell_lengths_only_where_points_do_not(lengths, expected):
    assert kinds(of_all(a_recording(), SIZED.body, size=True, lengths=lengths, surfaces=True)) == expected


def test_a_sensors_unknown_begins_where_most_of_its_rows_agree():
    """It is 0.3 m off at 1 mm of standard deviation, where a robust loss pulls no more; one row of seven is wrong."""
    states, post = measured.arms(7, seed=2), np.array([0.5, 1.2, 0.4])
    points = ARM.landmarks.select(("r_dactylion",))
    away = [np.linalg.norm(post - ARM.positions(s, points)[0]) for s in states]
    posts = [post + (a - 0.7) / a * (ARM.positions(s, points)[0] - post) for a, s in zip(away, states)]
    posts[3] = posts[3] + 0.2  # the hand is 0.7 m from all others
    steps = [[Pulling("rope", k / 10, p, taut=True)] for k, p in enumerate(posts)]
    recording = replace(a_recording(), markers=(), sensors=(Rope(),))
    found = of_all(recording, ARM, size=False, lengths=False, surfaces=False, steps=steps, states=states)
    assert found.start == pytest.approx(0.7, abs=0.002)


def test_a_body_of_known_size_leaves_nothing_to_find():
    assert of_all(a_recording(), SIZED.body, size=False, lengths=True, surfaces=True) is None


def test_markers_places_are_as_far_off_as_the_take_shows():
    random = np.random.default_rng(2)
    motion = squat_and_wave(BODY, rate=5.0, duration=3.0)
    points = BODY.markers("HANIM_45")
    z = {}
    for off in (0.004, 0.016):
        worn = replace(points, points=points.points + random.normal(0.0, off, points.points.shape))
        x = motion.positions(worn) + random.normal(0.0, 0.001, (len(motion), len(points), 3))
        steps = [[MarkerFrame("m", t, points.names, at, "HANIM_45")] for t, at in zip(motion.times, x)]
        found = track(Recording.of_frames(steps, Rig(()), rate=5.0, up=motion.up), BODY)
        error = found.segment_poses()[..., :3, 3] - motion.segment_poses()[..., :3, 3]
        known = np.isfinite(found.joint_std)
        z[off] = np.sqrt(np.mean((error / found.joint_std)[known] ** 2))
    assert all(0.42 < value < 1.1 for value in z.values()), z
