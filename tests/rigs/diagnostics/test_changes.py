"""Clocks that jump or drift within a take, and cameras that are moved: which, when, and by how much; no others."""

from dataclasses import replace

import numpy as np
import pytest

from kinefit.findings import Edit
from kinefit.geometry import se3
from kinefit.rigs.diagnostics.checks import check_keypoints
from kinefit.simulation import known_motion, movement, simulate_keypoints, squat_and_wave, studio_rig

FINE, FRAMES = 5, 220  # frames of the fine motion are one of the recording
MOTION = squat_and_wave(rate=30.0 * FINE, duration=10.0)
RIG = studio_rig(MOTION)
SEEN = simulate_keypoints(MOTION, RIG, noise_px=2.0, outliers=0.05, missing=0.05, seed=3)
EVEN = FINE * np.arange(FRAMES)
MOVED = squat_and_wave(duration=5.0)
MOVED_RIG = studio_rig(MOVED)
NOISE = {"noise_px": 3.0, "outliers": 0.1, "missing": 0.1, "seed": 8}


def recorded(**rows):
    """What the cameras saw at some fine frames (F,) each; in step by default."""
    own = [(k, rows.get(k.camera, EVEN)) for k in SEEN]
    return [replace(k, points=k.points[r], confidence=k.confidence[r], rate=30.0) for k, r in own]


def findings(**rows):
    return [f for f in check_keypoints(RIG, recorded(**rows)).findings if f.severity in ("fault", "doubt")]


@pytest.mark.parametrize(("name", "frames", "at"), [("cam02", 7, 90), ("cam04", 11, 140)])
def test_frames_dropped_in_mid_take_are_a_step_with_its_frame(name, frames, at):
    (found,) = findings(**{name: EVEN + np.where(np.arange(FRAMES) < at, 0, FINE * frames)})
    assert (found.severity, found.kind, found.cameras) == ("fault", "time", (name,))
    assert f"{name} is {frames} frames ({1000 * frames / 30:.0f} ms) later than" in found.text
    frame = int(found.text.partition("from frame ")[2].split()[0])
    assert frame == pytest.approx(at, abs=8)
    part = [frame, FRAMES] if at < FRAMES // 2 else [0, frame]
    assert found.edits == (Edit("take", "frames", str(part)),)


def test_two_cameras_that_drop_frames_together_are_one_finding():
    late = EVEN + np.where(np.arange(FRAMES) < 100, 0, FINE * 9)
    (found,) = findings(cam01=late, cam03=late)
    assert found.cameras == ("cam01", "cam03")
    assert "are 9 frames" in found.text and "cannot be seen" in found.confidence


@pytest.mark.parametrize(("name", "rate"), [("cam01", 25.0), ("cam03", 31.5)])
def test_another_rate_is_a_drift_and_no_offset(name, rate):
    (found,) = findings(**{name: np.round(30.0 / rate * EVEN).astype(int)[:FRAMES]})
    assert (found.severity, found.kind, found.cameras) == ("fault", "rate", (name,))
    (edit,) = found.edits
    assert (edit.table, edit.key, edit.entry) == ("keypoints", "rate", name)
    assert float(edit.value) == pytest.approx(rate, rel=0.015)


@pytest.mark.parametrize("rows", [{}, {"cam02": EVEN + 5 * FINE}, {"cam04": EVEN + 12 * FINE}])
def test_constant_offsets_are_neither(rows):
    found = findings(**rows)
    assert {name for f in found for name in f.cameras} <= set(rows)
    assert not [f for f in found if f.kind != "time" or "not before" in f.text]


def looped(motion, frames, still=False):
    """Frames of a movement that begins anew when it ends, or of its first pose."""
    at = np.zeros(frames, int) if still else np.arange(frames) % len(motion)
    return known_motion(motion.body, motion.rate, motion.Ts_world_root[at], motion.angles[at], up="y", name="looped")


def alarms(motion, late):
    """Findings on clocks where cam02 loses frames in mid-take, 220 frames of which are recorded."""
    rig, rows = studio_rig(motion), np.arange(220)
    seen = simulate_keypoints(motion, rig, noise_px=2.0, outliers=0.05, missing=0.05, seed=4)
    at = {"cam02": rows + np.where(rows < 110, 0, late)}
    seen = [replace(k, points=k.points[r], confidence=k.confidence[r]) for k in seen for r in [at.get(k.camera, rows)]]
    return [f for f in check_keypoints(rig, seen, up="y").findings if f.kind in ("time", "rate") and f.severity in
            ("fault", "doubt")]  # fmt: skip


def test_a_movement_that_repeats_itself_gives_no_other_period():
    steps = looped(movement("walk", rate=30.0, speed=4.0), 260)
    assert not alarms(steps, 0)
    (found,) = alarms(steps, 6)
    assert found.cameras == ("cam02",) and "is 6 frames (200 ms) later" in found.text


def test_the_clocks_of_a_person_who_stands_still_are_not_judged():
    assert not alarms(looped(movement("walk", rate=30.0), 260, still=True), 6)


def test_a_take_shorter_than_six_seconds_has_no_steps():
    late = EVEN + np.where(np.arange(FRAMES) < 90, 0, FINE * 7)
    short = [k.rows(slice(0, 170), 0.0) for k in recorded(cam02=late)]
    assert not [f for f in check_keypoints(RIG, short).findings if "not before" in f.text or f.kind == "rate"]


def turned(rig, name, degrees, axis):
    T = se3.transform(se3.exp_so3(np.radians(degrees) * np.eye(3)[axis]), np.zeros(3))
    return rig.with_camera(rig[name].with_pose(T @ rig[name].T_camera_world))


def kicked(rig, name, at, degrees, axis):
    """Keypoints of a camera that is turned from a frame on."""
    before, after = (simulate_keypoints(MOVED, r, **NOISE) for r in (rig, turned(rig, name, degrees, axis)))
    for a, b in zip(before, after):
        a.points.flags.writeable = a.confidence.flags.writeable = True
        a.points[at:], a.confidence[at:] = b.points[at:], b.confidence[at:]
    return before


@pytest.mark.parametrize(("name", "at", "degrees", "axis"), [("cam02", 60, 1.0, 0), ("cam01", 100, 2.0, 1),
                                                             ("cam04", 85, 4.0, 2), ("cam03", 50, 6.0, 0)])  # fmt: skip
def test_the_moved_camera_is_named_with_its_frame(name, at, degrees, axis):
    found = check_keypoints(MOVED_RIG, kicked(MOVED_RIG, name, at, degrees, axis)).findings
    found = [f for f in found if f.severity in ("fault", "doubt")]
    assert [(f.severity, f.kind, f.cameras) for f in found] == [("fault", "kicked", (name,))]
    assert int(found[0].text.partition("moved at frame ")[2].partition(":")[0]) == pytest.approx(at, abs=4)


def test_of_three_cameras_the_moved_one_is_named_too():
    rig = MOVED_RIG.select(("cam01", "cam02", "cam04"))
    found = check_keypoints(rig, kicked(rig, "cam02", 70, 2.0, 0)).faults
    assert [(f.kind, f.cameras) for f in found] == [("kicked", ("cam02",))]


def test_a_camera_turned_all_the_time_did_not_move():
    seen = simulate_keypoints(MOVED, MOVED_RIG, **NOISE)
    for rig in (MOVED_RIG, turned(MOVED_RIG, "cam02", 1.0, 0)):
        assert not [f for f in check_keypoints(rig, seen).findings if f.kind == "kicked"]
