"""Person, points, cameras and a sensor's own unknowns from all sensors together: truth comes back, bars are true."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from tests.fitting.subject import measured
from tests.fitting.subject.measured import ARM, HUMANOID, RIG, Pulling, Rope

from kinefit.bodies import PointSet
from kinefit.errors import ObservationError
from kinefit.fitting.subject.fit import fit_subject
from kinefit.fitting.subject.parameters import PointOffsets, SegmentScales
from kinefit.fitting.subject.subject import CameraExtrinsics, OwnUnknowns
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.sensors.base import Measurement, RowsOf

POST = np.array([0.3, -1.5, 0.3])


def grown(body, seed=0, spread=0.05):
    """Lengths of a person, in logarithms."""
    return np.random.default_rng(seed).normal(scale=spread, size=len(body.scale_groups)) + 0.03


def within(subject, truth, bars=4.0):
    return np.abs(subject.mean - truth) < bars * subject.std


def test_lengths_and_keypoints_of_a_person_come_back_from_pixels():
    """From 6 frames of four cameras; a bone that both its points lengthen looks the same as a longer one."""
    truth = grown(HUMANOID, 1)
    parameters = [SegmentScales(HUMANOID), PointOffsets(HUMANOID, "BODY_25B", 0.005)]
    shifts = np.random.default_rng(1).normal(scale=0.005, size=len(parameters[1].names))
    shifts *= np.sqrt(np.diag(parameters[1].information)) <= 1.0 / 0.005 + 1e-6
    body = HUMANOID.scaled(np.exp(truth))
    body = body.with_keypoints("BODY_25B", body.keypoints("BODY_25B").points + parameters[1].shifts(shifts))
    states = measured.people(6)
    steps = measured.pixels(body, states)
    subject = fit_subject(HUMANOID, RIG, steps, measured.shaken(states), parameters, rounds=2)
    before = np.linalg.norm(HUMANOID.tree.offsets - body.tree.offsets, axis=1)
    after = np.linalg.norm(subject.body.tree.offsets - body.tree.offsets, axis=1)
    assert before.max() > 0.02
    assert np.median(after) < 0.006
    assert after.max() < 0.02
    assert within(subject, np.concatenate([truth, shifts]), 3.0).mean() > 0.95
    assert set(subject.excess) == set(RIG.names)
    assert max(subject.excess.values()) < 3.0


def test_markers_of_unknown_places():
    truth, random = grown(ARM, 5), np.random.default_rng(2)
    body = ARM.scaled(np.exp(truth))
    shifts = random.normal(scale=0.01, size=(len(ARM.landmarks), 3))
    worn = body.markers("worn")
    body = replace(body, marker_sets={"worn": PointSet(worn.names, worn.segments, worn.points + shifts)})
    states = measured.arms(25)
    steps = measured.markers(body, states)
    offsets = PointOffsets(ARM, "worn", 0.01)
    assert not offsets._shared[1].min() < 0  # markers are shifted one by one
    subject = fit_subject(ARM, RIG, steps, measured.shaken(states), [SegmentScales(ARM), offsets])
    gap = np.linalg.norm(subject.body.tree.offsets - body.tree.offsets, axis=1)
    assert gap.max() < 0.006
    assert within(subject, np.concatenate([truth, shifts.ravel()])).mean() > 0.95
    assert np.linalg.norm(subject.body.markers("worn").points - body.markers("worn").points, axis=1).max() < 0.012


def reached(body, states):
    hand = body.landmarks.select(("r_dactylion",))
    return np.array([np.linalg.norm(POST - body.positions(s, hand)[0]) for s in states])


@pytest.mark.parametrize("noise", [0.0, 0.002])
def test_the_unknown_length_of_a_rope_that_only_pulls(noise):
    """No more is known than that the hand was never farther away: its length is the longest distance reached."""
    states = measured.arms(12, seed=4)
    steps = [[*one, Pulling("rope", one[0].time, POST)] for one in measured.markers(ARM, states, noise=noise)]
    longest = reached(ARM, states).max()
    assert longest > 1.1
    subject = fit_subject(ARM, RIG, steps, states, [OwnUnknowns.of([Rope()])])
    assert abs(subject.value("rope length")[0] - longest) < 0.005
    assert subject.values["rope"]["length"] == subject.value("rope length")[0]


def test_where_a_load_cell_says_that_the_rope_pulls_its_length_has_a_bar():
    """Taut in three frames of twelve, with a person whose lengths are unknown, too."""
    truth, length = grown(ARM, 8, 0.03), 1.12
    body = ARM.scaled(np.exp(truth))
    states = [s for s in measured.arms(3000, seed=4) if reached(body, [s])[0] < length]
    taut = sorted(states, key=lambda s: length - reached(body, [s])[0])[:3]
    assert np.all(np.abs(reached(body, taut) - length) < 0.003)
    states = [*taut, *states[:9]]
    steps = measured.markers(body, states, noise=0.002)
    steps = [[*one, Pulling("rope", one[0].time, POST, k < 3)] for k, one in enumerate(steps)]
    subject = fit_subject(ARM, RIG, steps, measured.shaken(states), [SegmentScales(ARM), OwnUnknowns.of([Rope()])])
    found, std = subject.value("rope length")
    assert abs(found - length) < 0.005
    assert 2e-4 < std < 0.004
    assert within(subject, np.append(truth, length)).all()
    assert not subject.unmeasured


def test_a_rope_that_is_always_slack_tells_nothing():
    states = measured.arms(5, seed=4)
    near = np.array([0.1, -0.6, 0.1])
    steps = [[*one, Pulling("rope", one[0].time, near)] for one in measured.markers(ARM, states)]
    subject = fit_subject(ARM, RIG, steps, states, [OwnUnknowns.of([Rope()])])
    assert subject.value("rope length") == pytest.approx((1.0, 0.3))
    assert [one.names for one in subject.unmeasured] == [("rope length",)]


def test_cameras_that_were_moved_beside_markers():
    """Markers hold the world and tell lengths; all four cameras are found, from keypoints that sit on the body."""
    twists = np.random.default_rng(3).normal(scale=(0.01,) * 3 + (0.005,) * 3, size=(4, 6))
    moved = Rig(tuple(c.with_pose(se3.exp(t) @ c.T_camera_world) for c, t in zip(RIG, twists)))
    states = measured.people(5)
    seen = measured.pixels(HUMANOID, states, rig=moved, points="COCO_17", noise=0.5)
    worn = measured.markers(HUMANOID, states, points="HANIM_45")
    steps = [a + b for a, b in zip(seen, worn)]
    subject = fit_subject(HUMANOID, RIG, steps, states, [CameraExtrinsics(RIG, None, (0.01, 0.005))], rounds=2)
    assert within(subject, twists.ravel()).all()
    assert np.abs(subject.mean - twists.ravel()).max() < 0.006
    assert np.all(subject.std.reshape(4, 6)[:, 3:] < 0.002)
    assert set(subject.excess) == {*RIG.names, "mocap"}


def test_a_camera_is_the_gauge():
    states = measured.people(4)
    steps = measured.pixels(HUMANOID, states, points="COCO_17", noise=0.5)
    held = RIG.names[0]
    pinned = fit_subject(HUMANOID, RIG, steps, states, [CameraExtrinsics(RIG, held)], rounds=1)
    adrift = fit_subject(HUMANOID, RIG, steps, states, [CameraExtrinsics(RIG, None)], rounds=1)
    assert np.array_equal(pinned.rig[held].T_camera_world, RIG[held].T_camera_world)
    assert len(pinned.mean) == 18
    assert not pinned.unmeasured
    assert len(adrift.unmeasured) == 6  # the whole world may move
    assert max(one.share for one in adrift.unmeasured) < 0.01


def test_bars_are_true():
    """Twenty people of lengths as the prior has them: squared errors in variances average to about one."""
    scales = SegmentScales(ARM)
    L = np.linalg.cholesky(np.linalg.inv(scales.information))
    square, excess = [], []
    for seed in range(20):
        truth = L @ np.random.default_rng(seed).normal(size=len(L))
        body, states = ARM.scaled(np.exp(truth)), measured.arms(5, seed)
        steps = measured.markers(body, states, noise=0.005, seed=seed)
        subject = fit_subject(ARM, RIG, steps, measured.shaken(states, 0.02), [scales], rounds=2)
        away = subject.mean - truth
        square.append(float(away @ np.linalg.solve(subject.covariance, away)) / len(away))
        excess.append(subject.excess["mocap"])
    assert 0.5 < np.mean(square) < 1.5  # of 60 axes: 1 ± 0.2
    assert np.median(excess) < 1.6


def test_errors_that_last_make_bars_wider():
    """Markers beside where the body has them, which is not fitted: many frames are no better than one."""
    states = measured.arms(20)
    shifts = np.random.default_rng(0).normal(scale=0.01, size=(len(ARM.landmarks), 3))
    points = ARM.landmarks
    worn = replace(ARM, marker_sets={"worn": PointSet(points.names, points.segments, points.points + shifts)})
    lasting = fit_subject(ARM, RIG, measured.markers(worn, states, noise=0.005), states, [SegmentScales(ARM)])
    fresh = fit_subject(ARM, RIG, measured.markers(ARM, states, noise=0.005), states, [SegmentScales(ARM)])
    assert lasting.excess["mocap"] > 10.0 > 2.0 > fresh.excess["mocap"]
    assert np.all(lasting.std > 2.0 * fresh.std)
    assert within(lasting, 0.0).all()
    one = fit_subject(ARM, RIG, measured.markers(ARM, states, noise=0.005), states, [SegmentScales(ARM)], looks=1.0)
    assert one.excess == {"mocap": pytest.approx(20.0)}
    assert np.all(one.std > 3.0 * fresh.std)


def test_a_length_that_nothing_measures_goes_with_the_others():
    states = measured.arms(8)
    truth = np.log([1.1, 1.1, 1.1])
    body = ARM.scaled(np.exp(truth))
    keep = tuple(n for n, s in zip(ARM.landmarks.names, ARM.landmarks.segments) if s < 3)
    few = replace(body, marker_sets={"worn": body.landmarks.select(keep)})
    plain = replace(ARM, marker_sets={"worn": ARM.landmarks.select(keep)})
    subject = fit_subject(plain, RIG, measured.markers(few, states), states, [SegmentScales(plain)])
    length, std = subject.value("length hand")
    assert 0.06 < length < 0.1
    assert std == pytest.approx(0.05 * np.sqrt(1.5), rel=0.2)
    assert [one.names for one in subject.unmeasured] == [("length hand",)]


@dataclass(frozen=True, eq=False)
class Fickle(Measurement):
    """Gives another number of rows of a longer body."""

    sensor: str = "fickle"
    time: float = 0.0

    def match(self, scene, reach):
        def rows(scene):
            hand = scene.body.landmarks.select(("r_dactylion",))
            out = scene.along(hand, [[1.0, 0.0, 0.0]], [0.0], 0.01)
            return [out] * (1 + int(scene.body.stature > ARM.stature))

        return RowsOf(rows)


def test_a_sensor_whose_rows_change_is_named():
    states = measured.arms(1)
    with pytest.raises(ObservationError, match="fickle"):
        fit_subject(ARM, RIG, [[Fickle()]], states, [SegmentScales(ARM)])


def test_what_cannot_be_fitted_is_refused():
    states = measured.arms(1)
    steps = measured.markers(ARM, states)
    with pytest.raises(ObservationError, match="1 frames of measurements but 2 states"):
        fit_subject(ARM, RIG, steps, states * 2, [SegmentScales(ARM)])
    with pytest.raises(ObservationError, match="no parameters"):
        fit_subject(ARM, RIG, steps, states, [])
    with pytest.raises(ObservationError, match="two parameters named 'length"):
        fit_subject(ARM, RIG, steps, states, [SegmentScales(ARM), SegmentScales(ARM)])
