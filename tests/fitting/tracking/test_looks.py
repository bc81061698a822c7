"""Images that the detector skips: the motion goes on between two looks, with its bars, and nothing of it is lost."""

from dataclasses import replace

import numpy as np
import pytest

from kinefit import Recording, load_body, track
from kinefit.errors import ObservationError
from kinefit.fitting.smoothing.smoother import as_tracked
from kinefit.fitting.tracking.run import run
from kinefit.observations.clocks import on_steps
from kinefit.sensors.settings import TrackSettings
from kinefit.simulation import resampled, simulate_keypoints, squat_and_wave, studio_rig
from kinefit.simulation.evaluation import coverage_of_groups, joint_errors

STEP = 4
BODY = load_body("humanoid")


def sparse(records, step=STEP, *, told=True):
    """Every so many frames alone, and the last; `told`: the others are said to be skipped, not without anybody."""
    looked = np.arange(len(records[0])) % step == 0
    looked[-1] = True
    return [replace(k.without(~looked), looked=looked if told else None) for k in records]


@pytest.fixture(scope="module")
def scene():
    """One and a half seconds of squatting and waving at 60 Hz before three cameras."""
    truth = resampled(squat_and_wave(rate=60), 60).part(slice(0, 90))
    rig = studio_rig(truth, cameras=3)
    noise = {"noise_px": 2.0, "drift_px": 2.0, "drift_time": 0.5, "outliers": 0.0, "missing": 0.0}
    return truth, rig, simulate_keypoints(truth, rig, "MEDIAPIPE_33", seed=1, **noise)


@pytest.fixture(scope="module")
def recording(scene):
    truth, rig, _ = scene
    return lambda records: Recording.of_keypoints(rig, records, sigma=8.0, up=truth.up)


@pytest.fixture(scope="module")
def motions(recording, scene):
    """With every look, and with every fourth."""
    seen = scene[2]
    return [track(recording(records), BODY, size=False) for records in (seen, sparse(seen))]


def test_between_looks_nothing_is_lost_and_quality_is_that_of_the_looks(motions):
    every, some = motions
    assert len(some) == len(every) == 90 and not some.lost.any()
    assert some.quality.min() > 0.9 * every.quality.min()
    between = some.quality[1:4]
    np.testing.assert_allclose(between, min(some.quality[0], some.quality[4]))


def test_frames_without_anybody_are_still_lost(recording, scene):
    motion = track(recording(sparse(scene[2], told=False)), BODY, size=False)
    assert motion.lost[1:4].all() and (motion.quality[1:4] == 0.0).all()


def test_the_motion_between_looks_is_as_near_to_the_truth_as_at_them(motions, scene):
    truth = scene[0]
    errors = [np.median(joint_errors(truth, motion)) for motion in motions]
    assert errors[1] < 1.25 * errors[0]
    gap = np.linalg.norm(motions[1].joint_centres - motions[0].joint_centres, axis=-1).mean(axis=1)
    looked = np.arange(90) % STEP == 0
    assert gap[~looked].mean() < 1.3 * gap[looked].mean()


def test_bars_hold_the_truth_as_often_as_with_every_look(motions, scene):
    shares = []
    for motion in motions:
        groups = coverage_of_groups(scene[0], motion).values()
        shares.append(np.nanmean([share.joints for share in groups]))
    assert shares[1] > shares[0] - 0.04
    std = [np.median(motion.joint_std) for motion in motions]
    assert std[1] > std[0], "fewer looks tell less"


def test_a_motion_without_smoothing_goes_on_as_well(recording, scene):
    some = track(recording(sparse(scene[2])), BODY, size=False, smooth=False)
    assert not some.lost.any() and np.isfinite(some.joint_std).mean() > 0.99
    speed = np.linalg.norm(np.diff(some.joint_centres, axis=0), axis=-1)
    held = np.median(speed[2::STEP]) / np.median(speed)
    assert held > 0.3, "between two looks the body moves on and does not wait for the next one"


def test_one_look_counts_for_all_images_since_the_last(recording, scene):
    """Errors of detectors last a quarter of a second, whatever the number of looks in it."""
    settings = TrackSettings()
    take = as_tracked(run(recording(sparse(scene[2])), BODY, settings))
    assert take.looked == pytest.approx(24 / 90)
    assert as_tracked(run(recording(scene[2]), BODY, settings)).looked == 1.0


def test_the_size_is_found_from_looks_alone(recording, scene):
    every, some = (track(recording(records), BODY).body.stature for records in (scene[2], sparse(scene[2])))
    assert some == pytest.approx(every, rel=0.01)


def test_looks_go_with_their_frames(scene):
    record = sparse(scene[2])[0]
    np.testing.assert_array_equal(record.rows(slice(3, 9), 0.05).looked, record.looked[3:9])
    steps = on_steps(record, record.times, 60.0, (2, 12))
    np.testing.assert_array_equal(steps.looked, record.looked[2:12])
    with pytest.raises(ObservationError, match="looks"):
        replace(record, looked=np.ones(3, bool))
