"""A live session becomes a motion: as from a recording, with steps dropped, cameras missing, sensors in turn."""

import numpy as np
import pytest
from tests.fitting.tracking.movements import (
    BODY,
    RATE,
    SET,
    STILL,
    a_motion,
    a_rig,
    a_tracker,
    depth_frame,
    keypoint_frame,
    off,
)

from kinefit import BodyState, Recording, track
from kinefit.errors import ObservationError
from kinefit.fitting.subject.subject import Subject

COLOUR = "left", "right"
SIGMA = dict.fromkeys(COLOUR, 2.0)


def seen(i, cameras=COLOUR, depth=False):
    return [keypoint_frame(i, c) for c in cameras] + ([depth_frame(i)] if depth else [])


def run(steps, **more):
    tracker = a_tracker(keep=True, sigma=SIGMA, up=(0.0, 0.0, 1.0), **more)
    for frames in steps:
        tracker.update(frames)
    return tracker


def error(motion, frames):
    """(F,) [m] mean over the landmarks."""
    states = [BodyState(T, q) for T, q in zip(motion.Ts_world_root, motion.angles)]
    return np.array([off(state, i).mean() for state, i in zip(states, frames, strict=True)])


@pytest.mark.parametrize("depth", [False, True])
@pytest.mark.parametrize("smooth", [False, True])
def test_a_session_is_the_motion_of_its_recording(smooth, depth):
    count = 8 if depth else 20
    steps = [seen(i, depth=depth) for i in range(count)]
    live = run(steps).motion(smooth=smooth)
    recording = Recording.of_frames(steps, a_rig(), rate=RATE, sigma=SIGMA, start=(0, a_motion().state(0)), up="z")
    subject = Subject(BODY, np.ones(len(BODY.scale_groups)))
    whole = track(recording, BODY, subject=subject, settings=STILL, smooth=smooth)
    np.testing.assert_allclose(live.times, whole.times, atol=1e-12)
    for field in ("Ts_world_root", "angles", "dof_std", "joint_std", "quality", "segment_quality"):
        np.testing.assert_allclose(getattr(live, field), getattr(whole, field), rtol=1e-6, atol=1e-9, err_msg=field)
    assert set(live.residuals) == set(whole.residuals) and live.up == whole.up == "z"
    for name, mine in live.residuals.items():
        np.testing.assert_allclose(mine.values, whole.residuals[name].values, atol=1e-6)
    assert live.provenance["estimate"] == whole.provenance["estimate"]
    assert error(live, range(count)).mean() < 0.02


def test_steps_dropped_are_bridged_and_unknown_where_nothing_is_smoothed():
    there = [i for i in range(24) if not 10 <= i < 14]
    tracker = run([seen(i) for i in there])
    live, causal = tracker.motion(), tracker.motion(smooth=False)
    assert len(live) == len(causal) == 24
    np.testing.assert_allclose(live.times, np.arange(24) / RATE, atol=1e-9)
    assert np.isinf(causal.dof_std[10:14]).all() and np.isfinite(causal.dof_std[14, :6]).all()
    assert error(live, range(24))[10:14].max() < 0.08
    assert live.provenance["frames"]["dropped"] == 4
    assert all(np.isnan(r.values[10:14]).all() and np.isfinite(r.values[14]).any() for r in live.residuals.values())


def test_cameras_may_come_and_go_and_take_turns():
    steps = [seen(i, COLOUR if i % 3 else COLOUR[:1]) for i in range(20)]
    live = run(steps).motion()
    assert np.isnan(live.residuals["right"].values[::3]).all()
    assert np.isfinite(live.residuals["right"].values[1]).any()
    assert error(live, range(20)).mean() < 0.02
    turns = [[f] for i in range(20) for f in seen(i)]  # a camera an update
    for k, frames in enumerate(turns):
        object.__setattr__(frames[0], "time", (k // 2 + 0.4 * (k % 2)) / RATE)
    live = run(turns).motion()
    assert len(live) == 20
    assert all(np.isfinite(live.residuals[c].values).any(axis=(1, 2)).all() for c in COLOUR)


def test_another_body_or_clock_begins_anew():
    tracker = run([seen(i) for i in range(6)])
    tracker.change_body(BODY.scaled(1.01 * np.ones(len(BODY.scale_groups))))
    tracker.update(seen(6))
    tracker.update(seen(7))
    motion = tracker.motion(smooth=False)
    assert len(motion) == 2 and motion.body is tracker.body
    for i in range(3):
        tracker.update([f.__class__(f.sensor, f.time - 50.0, f.names, f.uv, f.confidence, SET) for f in seen(8 + i)])
    assert len(tracker.motion(smooth=False)) == 3


def test_what_cannot_be_a_motion_is_told():
    with pytest.raises(ObservationError, match="keep=True"):
        a_tracker().motion()
    with pytest.raises(ObservationError, match="not found"):
        a_tracker(keep=True).motion()
    with pytest.raises(ObservationError, match="contacts=True needs smoothing"):
        run([seen(0)]).motion(smooth=False, contacts=True)
