"""Who is seen: lengths, how sure they are, and what another trial of the same person adds."""

from dataclasses import replace

import numpy as np
import pytest
from tests.oracle import posture, rig_around

from kinefit.bodies import BodyState, load_body
from kinefit.errors import TakeError
from kinefit.fitting.subject.keypoints import fit_subject
from kinefit.fitting.subject.parameters import World
from kinefit.fitting.subject.subject import CameraExtrinsics
from kinefit.observations import Keypoints
from kinefit.readers.take.file import read_take
from kinefit.sensors.channels import make_channels
from kinefit.sensors.settings import CameraErrors
from kinefit.simulation import cut, simulate_keypoints, squat_and_wave, studio_rig
from kinefit.solving.bundle.shape import mirror_points
from kinefit.takes.track import track_take, trial_of

BODY = load_body("humanoid")
SCALES = np.linspace(0.92, 1.08, len(BODY.scale_groups))
MOTION = replace(squat_and_wave(rate=20.0, duration=6.0), body=BODY.scaled(SCALES))
RIG = studio_rig(MOTION)


def channels_of(motion, noise_px, seed=0):
    seen = simulate_keypoints(motion, RIG, noise_px=noise_px, drift_px=noise_px, outliers=0.05, missing=0.05, seed=seed)
    return make_channels(BODY, RIG, seen, [8.0] * 4)


def spread(subject):
    """Standard deviations of the scales' logarithms."""
    return np.sqrt(np.diag(subject.covariance))[: len(SCALES)]


def test_lengths_are_found_within_what_they_tell_of_themselves():
    subject = fit_subject(BODY, channels_of(MOTION, 3.0))
    off = np.abs(np.log(subject.scales / SCALES)) / spread(subject)
    assert np.sqrt(np.mean(off**2)) < 2.0 and spread(subject).max() < 0.12
    told = subject.length_std
    lengths = np.linalg.norm(subject.body.tree.offsets, axis=1)
    shank = subject.body.tree.segment("shank_l")
    share = spread(subject)[BODY.scale_groups.index("thigh")]
    assert told["thigh_l-shank_l"] == pytest.approx(lengths[shank] * share)
    assert all(0 <= v < 0.05 for v in told.values())


def test_worse_keypoints_leave_the_lengths_less_sure():
    good, bad = (fit_subject(BODY, channels_of(MOTION, noise)) for noise in (1.0, 8.0))
    assert np.median(spread(bad) / spread(good)) > 1.3


def test_a_trial_of_the_same_person_helps_a_take_that_tells_little():
    trial = fit_subject(BODY, channels_of(MOTION, 1.0))
    short = channels_of(cut(MOTION, 40, 44), 8.0, seed=1)
    alone, helped = fit_subject(BODY, short), fit_subject(BODY, short, trial=trial)
    assert np.abs(helped.scales - SCALES).mean() < 0.8 * np.abs(alone.scales - SCALES).mean()
    assert np.median(spread(helped) / spread(alone)) < 0.7


def test_cameras_are_found_along_as_near_to_their_calibration_as_it_is_sure():
    random = np.random.default_rng(5)
    errors = CameraExtrinsics(RIG, None)
    twist = np.concatenate([random.normal(0.0, (0.01,) * 3 + (0.005,) * 3) for _ in RIG])
    off = errors.apply(World(BODY, RIG), twist).rig
    channels = replace(channels_of(MOTION, 1.0), rig=off)
    exact, moved = fit_subject(BODY, channels), fit_subject(BODY, channels, cameras=CameraErrors(0.01, 0.005))
    held = fit_subject(BODY, channels, cameras=CameraErrors(1e-6, 1e-6))
    assert exact.fit.rig is off and len(held.fit.mean) == len(exact.fit.mean) + 24

    def apart(rig):  # between cameras: all together may stand elsewhere
        T = [a.T_camera_world @ np.linalg.inv(rig.cameras[0].T_camera_world) for a in rig]
        T0 = [a.T_camera_world @ np.linalg.inv(RIG.cameras[0].T_camera_world) for a in RIG]
        return np.mean([np.linalg.norm(a[:3, :3] - b[:3, :3]) for a, b in zip(T[1:], T0[1:])])

    assert apart(moved.fit.rig) < 0.5 * apart(off)
    np.testing.assert_allclose(apart(held.fit.rig), apart(off), rtol=1e-3)
    std = np.sqrt(np.diag(moved.covariance))[-24:]
    assert np.all(std < np.tile(np.repeat((0.0101, 0.00505), 3), 4)) and np.median(std[3:6]) < 0.004
    assert np.all(spread(moved) < 1.5 * spread(exact))


def people(scales, noise, count=20, shifts=None, unseen=()):
    """Channels of a person in some postures near the origin, with points (K, 3) [m] beside the body's; and states."""
    body, random = BODY.scaled(scales), np.random.default_rng(0)
    points = body.keypoints("BODY_25B")
    points = replace(points, points=points.points + (0.0 if shifts is None else shifts))
    states = []
    for k in range(count):
        T = np.array(posture(BODY, 100 + k, 0.35).T_world_root)
        T[:3, 3] *= 0.2
        states.append(BodyState(T, posture(BODY, 100 + k, 0.35).angles))
    x = np.stack([body.positions(s, points) for s in states])
    rig, records = rig_around((0.0, 0.0, 0.0), cameras=4), []
    seen = np.array([[n not in unseen for n in points.names]] * count, float)[:, None]
    for camera in rig:
        uv = camera.project(x)[:, None]
        uv = uv + noise * random.normal(size=uv.shape)
        records.append(Keypoints(camera.name, "BODY_25B", points.names, 30.0, uv, seen))
    return make_channels(BODY, rig, records, [max(noise, 0.5)] * 4), x


@pytest.mark.parametrize(("shifted", "within"), [(False, 0.04), (True, 0.06)])
def test_a_known_person_comes_back(shifted, within):
    """Where the detector's points sit 1 cm beside the joints to every side, lengths less surely: both look alike.

    Noise of 2 px and random postures, which no prior posture has, leave 1 to 2.5 % of a length.
    """
    random = np.random.default_rng(0)
    scales = 1.03 * random.uniform(0.9, 1.12, len(SCALES))
    lead, sign = mirror_points(BODY.keypoints("BODY_25B"), BODY.tree.segments)
    ones = np.ones(len(lead))
    shifts = random.normal(scale=0.01 * shifted, size=(len(lead), 3))[lead] * np.stack([ones, ones, sign]).T
    channels, x = people(scales, 2.0, shifts=shifts)
    subject = fit_subject(BODY, channels)
    found = np.stack([subject.body.positions(s, subject.body.keypoints("BODY_25B")) for s in subject.fit.states])
    assert np.linalg.norm(found - x, axis=-1).mean() < 0.009
    limbs = [BODY.scale_groups.index(name) for name in ("thigh", "shank", "upperarm", "forearm")]
    np.testing.assert_allclose(subject.scales[limbs], scales[limbs], rtol=within)
    moved = subject.body.keypoints("BODY_25B").points - BODY.scaled(subject.scales).keypoints("BODY_25B").points
    alike = np.stack([ones, ones, np.where(sign == 0.0, 1.0, sign)]).T
    np.testing.assert_allclose(moved, moved[lead] * alike, atol=1e-12)
    assert np.abs(moved).max() > 1e-4


def test_a_length_that_nobody_sees_follows_the_others():
    unseen = [n for n in BODY.keypoints("BODY_25B").names if any(p in n for p in ("Knee", "Ankle", "Toe", "Heel"))]
    channels, _ = people(np.full(len(SCALES), 1.12), 2.0, 8, unseen=unseen)
    shank = BODY.scale_groups.index("shank")
    free, told = fit_subject(BODY, channels), fit_subject(BODY, channels, height=1.05 * BODY.stature)
    assert free.scales[shank] == pytest.approx(1.12, abs=0.03)
    assert told.scales[shank] < free.scales[shank]


def test_exact_pixels_of_a_body_of_usual_shape_leave_it_as_it_is():
    channels, _ = people(np.ones(len(SCALES)), 0.0, 5)
    np.testing.assert_allclose(fit_subject(BODY, channels).scales, 1.0, atol=0.02)


def test_a_worse_detector_beside_a_better_one_does_no_harm():
    """Lengths by two detectors, of which one errs eight times as much, are no worse than by the better one alone."""

    def wrong(*detectors):
        errors = []
        for seed in range(3):
            seen = [
                k for s, noise in detectors
                for k in simulate_keypoints(MOTION, RIG, s, noise_px=noise, outliers=0.0, missing=0.0, seed=seed)
            ]  # fmt: skip
            subject = fit_subject(BODY, make_channels(BODY, RIG, seen, [8.0] * len(seen)))
            errors.append(np.abs(subject.scales / SCALES - 1.0).mean())
        return np.mean(errors)

    good = ("BODY_25B", 2.0)
    assert wrong(good, ("MEDIAPIPE_33", 16.0)) < wrong(good)


@pytest.fixture(scope="module")
def two_takes(tmp_path_factory, copy_take):
    folder = tmp_path_factory.mktemp("takes")
    trial = copy_take(folder)
    text = trial.read_text("utf-8").replace("[take]", f'[take]\nsubject = "{trial.name}"', 1)
    (folder / "second.toml").write_text(text, "utf-8")
    return trial, folder / "second.toml"


def test_a_take_names_its_trial(two_takes):
    trial, second = two_takes
    assert trial_of(read_take(trial)) is None
    first, _ = track_take(trial, smooth=False)
    motion, _ = track_take(second, smooth=False)
    np.testing.assert_allclose(motion.body.tree.offsets, first.body.tree.offsets, atol=0.01)
    assert np.any(motion.body.tree.offsets != first.body.tree.offsets)


def test_a_trial_of_another_body_is_refused(two_takes):
    _, second = two_takes
    with pytest.raises(TakeError, match="body") as caught:
        trial_of(replace(read_take(second), body="humanoid10"))
    assert caught.value.place == "[take] subject"
