"""Unknowns of sensors in the smoother: all frames of a take tell them, and poses follow."""

from dataclasses import dataclass

import numpy as np
import pytest
from tests.fitting.subject import measured
from tests.fitting.subject.measured import ARM, RIG, Pulling, Rope

from kinefit import Recording, TrackSettings, track
from kinefit.fitting.smoothing.border import Border
from kinefit.observations import KeypointFrame
from kinefit.sensors import Unknown

RATE, LENGTH, POST = 30.0, 0.8, np.array([0.9, 0.3, 0.9])
HAND = ARM.landmarks.select(("r_dactylion",))


def swing(frames=60):
    """States of an arm that swings."""
    first, last = measured.arms(2, seed=5)
    phase = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(frames) / frames)
    return [first.retract(p * first.difference(last)) for p in phase]


def roped(states, taut, noise=1.0):
    """Steps of all cameras, and of a rope in frames `taut`, whose post is as far from the hand as it is long."""
    random = np.random.default_rng(1)
    points = ARM.keypoints("MEDIAPIPE_33")
    for k, state in enumerate(states):
        uv = [c.project(ARM.positions(state, points)) + noise * random.normal(size=(len(points), 2)) for c in RIG]
        frames = [
            KeypointFrame(c.name, k / RATE, points.names, own, np.ones(len(points)), "MEDIAPIPE_33")
            for c, own in zip(RIG, uv)
        ]
        if taut[k]:
            hand = ARM.positions(state, HAND)[0]
            post = hand + LENGTH * (POST - hand) / np.linalg.norm(POST - hand)
            frames.append(Pulling("rope", k / RATE, post, taut=True))
        yield frames


@pytest.fixture(scope="module")
def states():
    return swing()


@pytest.mark.parametrize("smooth", [True, False])
def test_a_rope_that_begins_far_from_its_length_drags_no_hand(states, smooth):
    taut = np.arange(len(states)) % 3 < 2
    steps = list(roped(states, taut))
    recording = Recording.of_frames(
        steps, RIG, rate=RATE, sensors=(Rope(),), sigma=dict.fromkeys(RIG.names, 1.0), start=(0, states[0]), up="y"
    )
    motion = track(recording, ARM, size=False, smooth=smooth, settings=TrackSettings(camera_std=None))
    length, std = motion.provenance["shape"]["rope length"]
    assert abs(length - LENGTH) < (0.005 if smooth else 0.01)
    assert abs(length - LENGTH) < 3.0 * std and std < (0.005 if smooth else 0.02)
    found = np.array([ARM.positions(s, HAND)[0] for s in map(motion.state, range(len(states)))])
    true = np.array([ARM.positions(s, HAND)[0] for s in states])
    assert np.median(np.linalg.norm(found - true, axis=1)) < 0.008


class Skin(Rope):
    """A sensor of surface rows with an unknown of its own, which the smoother's border leaves as it was found."""

    name, unknowns = "skin", {"length": Unknown(1.0, 0.3)}


@dataclass(frozen=True)
class Felt(Pulling):
    def match(self, scene, reach):
        matched = super().match(scene, reach)
        object.__setattr__(matched, "of_points", False)
        return matched


def test_what_only_surfaces_tell_is_left_as_the_subject_fit_has_it(states, monkeypatch):
    steps = list(roped(states, np.ones(len(states), bool)))
    for frames in steps:
        frames.append(Felt("skin", frames[-1].time, frames[-1].post, taut=True, sigma=0.005))
    sensors, sigma = (Rope(), Skin()), dict.fromkeys(RIG.names, 1.0)
    recording = Recording.of_frames(
        steps, RIG, rate=RATE, sensors=sensors, sigma=sigma, start=(0, states[0]), up="y"
    )  # fmt: skip
    first = []
    of = Border.of
    monkeypatch.setattr(Border, "of", lambda found: first.append(of(found)) or first[-1])
    shape = track(recording, ARM, size=False, settings=TrackSettings(camera_std=None)).provenance["shape"]
    before = dict(zip(first[0].unknowns.names, first[0].theta))
    assert abs(before["skin length"] - LENGTH) < 0.05  # far from its prior mean
    assert shape["skin length"][0] == pytest.approx(before["skin length"], abs=1e-4)
    assert abs(shape["rope length"][0] - LENGTH) < 0.005
