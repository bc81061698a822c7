"""Arguments of another type than is asked for are answered with an error that says what to give."""

import numpy as np
import pytest

from kinefit import Recording, Tracker, load_body, track
from kinefit.errors import KinefitError, ObservationError
from kinefit.fitting import FixedLag
from kinefit.observations import (
    DepthFrame,
    KeypointFrame,
    LineFrame,
    MarkerFrame,
    PointCloud,
    SilhouetteFrame,
)
from kinefit.simulation import squat_and_wave, studio_rig

BODY = load_body("humanoid")
RIG = studio_rig(squat_and_wave())
FRAME = KeypointFrame("cam01", 0.0, ("nose",), np.zeros((1, 2)), np.ones(1))
ENDS = np.arange(4.0).reshape(1, 2, 2) * 9.0


@pytest.mark.parametrize(
    "given",
    [
        {"body": "humanoid"}, {"body": None}, {"rig": None}, {"rig": [1]}, {"rate": "30"}, {"rate": None},
        {"rate": np.nan},
        {"sigma": [1]}, {"sigma": "8"}, {"sigma": {"cam01": "8"}}, {"sigma": {"cam01": None}}, {"up": "w"},
        {"up": None}, {"up": (1, 2)}, {"on_body": 3}, {"on_body": "cam01"}, {"settings": {"a": 1}}, {"sensors": 3},
        {"sensors": "abc"}, {"sensors": [3]}, {"values": 3}, {"values": "abc"}, {"values": {"a": 3}},
    ],
    ids=repr,
)  # fmt: skip
def test_a_tracker_is_made_of_what_it_asks_for(given):
    with pytest.raises(KinefitError):
        Tracker(**{"body": BODY, "rig": RIG, **given})


@pytest.mark.parametrize(
    "frames", [None, "abc", 3, (f for f in [FRAME]), FRAME, [None], ["a"], [3], {"cam01": FRAME}, np.array([FRAME])]
)
def test_frames_are_a_list_of_frames(frames):
    with pytest.raises(ObservationError, match="not a list|is not a frame"):
        Tracker(BODY, RIG).update(frames)


@pytest.mark.parametrize("call", [
    lambda t: t.update([FRAME], "now"), lambda t: t.update([FRAME], np.zeros(2)), lambda t: t.update([FRAME], others=3),
    lambda t: t.update([FRAME], others=[None]), lambda t: t.start_at("x"), lambda t: t.start_at(None),
    lambda t: t.start_at(np.zeros(5)), lambda t: t.backwards(None), lambda t: t.change_body("humanoid10"),
    lambda t: t.know_background("cam01", "text"), lambda t: t.know_background(None, None),
    lambda t: FixedLag(t, "0.1"), lambda t: FixedLag(t, None), lambda t: FixedLag("t", 0.1),
    lambda t: FixedLag(t, 0.1).add("x"), lambda t: FixedLag(t, 0.1).add([FRAME]),
])  # fmt: skip
def test_a_tracker_is_told_what_it_asks_for(call):
    with pytest.raises(KinefitError):
        call(Tracker(BODY, RIG))


@pytest.mark.parametrize("make", [
    lambda: KeypointFrame(None, 0.0, ("a",), [[1, 2]], [1]), lambda: KeypointFrame("a", "x", ("a",), [[1, 2]], [1]),
    lambda: KeypointFrame("a", 0.0, "n", [[1, 2]], [1]),
    lambda: KeypointFrame("a", 0.0, (n for n in "a"), [[1, 2]], [1]), lambda: DepthFrame("a", 0.0, [[1], [1, 2]]),
    lambda: KeypointFrame("a", 0.0, ("a",), "text", [1]), lambda: KeypointFrame("a", 0.0, ("a",), None, None),
    lambda: DepthFrame("a", 0.0, "text"), lambda: DepthFrame("a", 0.0, None),
    lambda: PointCloud("a", 0.0, "text"), lambda: PointCloud("a", None, np.zeros((1, 3))),
    lambda: PointCloud("a", 0.0, np.zeros((1, 3)), "eye"), lambda: SilhouetteFrame("a", 0.0, None),
    lambda: SilhouetteFrame("a", 0.0, "text"), lambda: SilhouetteFrame("a", 0.0, [[1], [1, 2]]),
    lambda: MarkerFrame("a", 0.0, None, None), lambda: MarkerFrame("a", 0.0, (1,), np.zeros((1, 3))),
    lambda: LineFrame("a", 0.0, ("a",), None, ENDS), lambda: LineFrame("a", 0.0, ("a",), (3,), ENDS),
    lambda: LineFrame("a", 0.0, ("a",), ((3,),), ENDS), lambda: LineFrame("a", 0.0, ("a",), ("elbow",), ENDS),
])  # fmt: skip
def test_a_frame_holds_what_it_says(make):
    with pytest.raises(ObservationError):
        make()


@pytest.mark.parametrize("make", [
    lambda: track("x", BODY), lambda: track(None, BODY), lambda: Recording.of_keypoints(RIG, "x"),
    lambda: Recording.of_keypoints(RIG, np.zeros(3)),
    lambda: Recording.of_keypoints(RIG, [None]), lambda: Recording.of_frames("x", RIG, rate=30.0),
    lambda: Recording.of_frames(([FRAME] for _ in range(3)), RIG, rate=30.0),
    lambda: Recording.of_frames([None], RIG, rate=30.0), lambda: Recording.of_frames([[FRAME]], None, rate=30.0),
    lambda: Recording.of_frames([[FRAME]], RIG, rate="30"),
    lambda: track(Recording.of_frames([[FRAME]], RIG, rate=30.0), "humanoid"),
])  # fmt: skip
def test_a_recording_is_made_of_what_it_asks_for(make):
    with pytest.raises(ObservationError):
        make()
