"""What is sought though nothing is lost: a thing of a limb's size that no part of the body explains."""

from dataclasses import replace

import numpy as np
import pytest
from tests.fitting.tracking.movements import a_motion, a_rig, depth_frame

from kinefit.bodies.rendering import render_body
from kinefit.fitting.tracking import recovery
from kinefit.fitting.tracking.tracker import Tracker
from kinefit.sensors.settings import TrackSettings


def with_a_thing(i):
    """A depth image of the body with something as large as a forearm beside its trunk."""
    frame = depth_frame(i)
    body = np.isfinite(render_body(a_motion().body, a_motion().state(i), a_rig()["depth"]).depth)
    rows, columns = np.nonzero(body)
    depth = np.array(frame.depth)
    row, column = int(np.median(rows)), int(columns.min()) - 2
    depth[row - 12 : row + 12, column - 10 : column] = np.median(depth[body])
    return replace(frame, depth=depth)


CASES = [(30.0, with_a_thing, 0), (1.0, with_a_thing, 1), (1.0, depth_frame, 0)]


@pytest.mark.parametrize(("rate", "sees", "times"), CASES)
def test_between_frames_far_apart_limbs_are_sought_for_what_nothing_explains(monkeypatch, rate, sees, times):
    sought = []
    monkeypatch.setattr(recovery.candidates, "find_limbs", lambda *_: sought.append(1) or [])
    monkeypatch.setattr(recovery.candidates, "starts_from_views", lambda *_, **__: [])
    settings = TrackSettings(doubtful=0.0)
    tracker = Tracker(a_motion().body, a_rig(), rate=rate, settings=settings, on_body=("depth",), up="y")
    tracker.start_at(a_motion().state(0))
    result = tracker.update([sees(0)])
    assert not result.lost.any()
    assert len(sought) == times


def test_a_limb_that_was_well_seen_at_this_very_time_may_move_as_far_as_in_a_frame():
    tracker = Tracker(a_motion().body, a_rig(), rate=30.0, up="y")
    tracker.start_at(a_motion().state(0))
    result, one = tracker.update([depth_frame(0)]), np.arange(len(a_motion().body.tree.segments)) == 1
    tracker._recovery._good[one] = result.time
    assert tracker._recovery._leap(result.time, result, result, one) == 1.0


@pytest.mark.parametrize(("sees", "said"), [(with_a_thing, True), (depth_frame, False)])
def test_limbs_that_could_be_what_nothing_explains_are_said_to_be_lost(monkeypatch, sees, said):
    monkeypatch.setattr(recovery.candidates, "find_limbs", lambda *_: [])
    monkeypatch.setattr(recovery.candidates, "starts_from_views", lambda *_, **__: [])
    tracker = Tracker(a_motion().body, a_rig(), rate=1.0, on_body=("depth",), up="y")
    tracker.start_at(a_motion().state(0))
    result = tracker.update([sees(0)])
    arms = [tracker.body.tree.segment(f"forearm_{side}") for side in "rl"]
    assert (result.segment_quality[arms] == 0.0).any() == said
    scene = tracker.scene_of(result.state, 0.0)
    again = result.measurements[0].compact().evidence(scene).segment_quality(tracker.body.tree)
    assert (again[arms] == 0.0).any() == said  # as smoothing judges it


def test_a_guess_is_taken_where_more_speaks_for_it(monkeypatch):
    monkeypatch.setattr(recovery.candidates, "find_limbs", lambda *_: [])
    monkeypatch.setattr(recovery.candidates, "starts_from_views", lambda *_, **__: [])
    away = a_motion().state(0)
    root = np.array(away.T_world_root)
    root[:3, 3] += 0.8
    wrong = replace(away, T_world_root=root)
    for guess, found in ((None, False), (away, True)):
        tracker = Tracker(a_motion().body, a_rig(), rate=1.0, on_body=("depth",), up="y")
        tracker.start_at(wrong)
        result = tracker.update([depth_frame(0)], guess=guess)
        off = np.linalg.norm(result.state.T_world_root[:3, 3] - away.T_world_root[:3, 3])
        assert (off < 0.05) == found


@pytest.mark.parametrize("order", [1, -1])
def test_of_starts_in_one_place_the_view_decides_and_not_the_number_of_segments_seen(monkeypatch, order):
    truth = a_motion().state(5)
    root = np.array(truth.T_world_root)
    root[:3, :3] = np.diag([-1.0, 1.0, -1.0]) @ root[:3, :3]
    away = replace(truth, T_world_root=root)
    monkeypatch.setattr(recovery.candidates, "starts_from_views", lambda *_, **__: [[truth, away][::order]])
    monkeypatch.setattr(recovery, "_better", lambda new, _: new.state.T_world_root[0, 0] * facing < 0.0)
    facing = truth.T_world_root[0, 0]
    result = Tracker(a_motion().body, a_rig(), rate=30.0, up="y").update([depth_frame(5)])
    assert result.state.T_world_root[:3, 0] @ truth.T_world_root[:3, 0] > 0.9
