"""Who is seen: lengths, how sure they are, and what another trial of the same person adds."""

from dataclasses import replace

import numpy as np
import pytest

from kinefit.bodies import load_body
from kinefit.errors import TakeError
from kinefit.readers.take.file import read_take
from kinefit.sensors.channels import make_channels
from kinefit.simulation import cut, simulate_keypoints, squat_and_wave, studio_rig, write_synthetic_take
from kinefit.subject.keypoints import fit_subject
from kinefit.tracking.take import track_take, trial_of

BODY = load_body("humanoid")
SCALES = np.linspace(0.92, 1.08, len(BODY.scale_groups))
MOTION = replace(squat_and_wave(rate=20.0, duration=6.0), body=BODY.scaled(SCALES))
RIG = studio_rig(MOTION)


def channels_of(motion, noise_px, seed=0):
    seen = simulate_keypoints(motion, RIG, noise_px=noise_px, drift_px=noise_px, outliers=0.05, missing=0.05, seed=seed)
    return make_channels(BODY, RIG, seen, [np.zeros(len(motion), int)] * 4, [8.0] * 4)


def spread(subject):
    return np.sqrt(np.diag(subject.covariance))[: len(SCALES)]


def test_lengths_are_found_within_what_they_tell_of_themselves():
    subject = fit_subject(BODY, channels_of(MOTION, 3.0))
    off = np.abs(subject.scales - SCALES) / spread(subject)
    assert np.sqrt(np.mean(off**2)) < 2.0 and spread(subject).max() < 0.12
    told = subject.length_std
    lengths = np.linalg.norm(subject.body.tree.offsets, axis=1)
    shank = subject.body.tree.segment("shank_l")
    share = spread(subject)[BODY.scale_groups.index("thigh")] / subject.scales[BODY.scale_groups.index("thigh")]
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


@pytest.fixture(scope="module")
def two_takes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("takes")
    trial = write_synthetic_take(folder)
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
